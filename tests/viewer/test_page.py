"""The pages that `p4dgs-ref view` writes: fresh, whole, and safe with any name of a file."""

import base64
import json
import re
import shutil
import subprocess

import pytest

from p4dgs_ref.report import view
from tests import ROOT
from tests.processes import CAPTURED
from tests.sampling import of_the_day, turn
from tests.workshop import demo, lambdas
from tutorials.tools.figures import THREAD

TUTORIALS = ROOT / "tutorials"
PAPER = "https://arxiv.org/abs/2510.10030"
PAGES = sorted((TUTORIALS / "viewer").glob("*.html"))


def held(page):
    """The files in a page, {name: bytes}, and its notes of them."""
    notes = {one.pop("name"): one for one in json.loads(re.search(r'id="files">(.*)</sc', page)[1])}
    return {name: base64.b64decode(note.pop("base64")) for name, note in notes.items()}, notes


def rebuilt(file):
    """The bytes of a page that is made anew, with the files that it holds."""
    return lambdas.page(*held(file.read_text(encoding="utf-8")))


@pytest.mark.parametrize("file", PAGES, ids=lambda file: file.name)
def test_the_pages_are_fresh(file):
    """CONTRIBUTING.md says how a stale one is made anew."""
    assert rebuilt(file) == file.read_bytes()


def test_the_page_holds_the_demo_first_and_files_of_other_lambda():
    assert [*PAGES] == [lambdas.PAGE] and lambdas.PAGE.stat().st_size < 600_000
    files, notes = held(lambdas.PAGE.read_text(encoding="utf-8"))
    assert [*files] == [lambdas.name_of(rate) for rate in lambdas.RATES]
    assert files["demo.p4dgs"] == (TUTORIALS / "demo.p4dgs").read_bytes()
    assert tuple(note["lambda_rate"] for note in notes.values()) == lambdas.RATES
    assert notes["demo.p4dgs"]["anchor"] == THREAD.index
    layers = (view.VIEWER / "layers.js").read_text(encoding="utf-8")
    assert f'MARKED = "{THREAD.color.lower()}"' in layers
    for name, data in files.items():
        assert lambdas.note(data, 0)["psnr_db"] == pytest.approx(notes[name]["psnr_db"], abs=0.01)


@pytest.mark.slow
@turn("another lambda")
@pytest.mark.skipif(demo.kept()["arithmetic"] != demo.with_what(), reason="another arithmetic")
@pytest.mark.parametrize("lambda_rate", of_the_day(lambdas.OTHERS))
def test_a_file_of_other_lambda_is_made_again(lambda_rate):
    files, _ = held(lambdas.PAGE.read_text(encoding="utf-8"))
    assert demo.file(lambda_rate=lambda_rate) == files[lambdas.name_of(lambda_rate)]


def test_a_page_is_whole_whatever_a_file_is_called():
    files = {"<!--<script>.p4dgs": b"1", "é\u2028.p4dgs": b"2"}
    page = view.page(files).decode()
    assert held(page)[0] == files and "<!--" not in page  # after which no script would end
    page = page.replace(f'<a href="{PAPER}" ', "<a ")  # a link; nothing else is outside
    assert not re.search(r"""\bsrc=|@import|\burl\(|fetch\(|https?:""", page)


def test_the_scripts_stay_short():
    texts = [file.read_text(encoding="utf-8") for file in sorted(view.VIEWER.glob("*.js"))]
    assert sum(len(text.splitlines()) for text in texts) <= 3300


@pytest.mark.slow
@pytest.mark.skipif(not all(map(shutil.which, ["node", "chromium"])), reason="no node, no chromium")
def test_the_guide_leads_through_a_file(tmp_path):
    """Ten steps in two windows; keys, fingers, links; no motion, no scripts, paper."""
    script = ROOT / "tests" / "workshop" / "browser.js"
    run = subprocess.run(["node", script, tmp_path, "guide"], **CAPTURED)
    assert run.returncode == 0, run.stdout + run.stderr
