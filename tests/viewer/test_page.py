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

TUTORIALS = ROOT / "tutorials"
PAPER = "https://arxiv.org/abs/2510.10030"
PAGES = sorted((TUTORIALS / "viewer").glob("*.html"))


def held(page):
    """The files in a page, {name: bytes}."""
    return {
        one["name"]: base64.b64decode(one["base64"])
        for one in json.loads(re.search(r'id="files">(.*)</script>', page)[1])
    }


def rebuilt(file):
    """The bytes of a page that is made anew, with the files that it holds."""
    return view.page(held(file.read_text(encoding="utf-8")))


@pytest.mark.parametrize("file", PAGES, ids=lambda file: file.name)
def test_the_pages_are_fresh(file):
    """CONTRIBUTING.md says how a stale one is made anew."""
    assert rebuilt(file) == file.read_bytes()


def test_the_page_holds_the_demo():
    (demo,) = (held(file.read_text(encoding="utf-8")) for file in PAGES)
    assert demo == {"demo.p4dgs": (TUTORIALS / "demo.p4dgs").read_bytes()}


def test_a_page_is_whole_whatever_a_file_is_called():
    files = {"<!--<script>.p4dgs": b"1", "é\u2028.p4dgs": b"2"}
    page = view.page(files).decode()
    assert held(page) == files and "<!--" not in page  # after which no script would end
    page = page.replace(f'<a href="{PAPER}" ', "<a ")  # a link; nothing else is outside
    assert not re.search(r"""\bsrc=|@import|\burl\(|fetch\(|https?:""", page)


def test_the_scripts_stay_short():
    texts = [file.read_text(encoding="utf-8") for file in sorted(view.VIEWER.glob("*.js"))]
    assert sum(len(text.splitlines()) for text in texts) <= 3300


@pytest.mark.slow
@pytest.mark.skipif(not all(map(shutil.which, ["node", "chromium"])), reason="no node, no chromium")
def test_the_guide_leads_through_a_file(tmp_path):
    """Eight steps in two windows; keys, fingers, links; no motion, no scripts, paper."""
    script = ROOT / "tests" / "golden" / "browser.js"
    run = subprocess.run(["node", script, tmp_path, "guide"], **CAPTURED)
    assert run.returncode == 0, run.stdout + run.stderr
