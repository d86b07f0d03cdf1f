"""Pages are true: their programs print what they show, their links lead somewhere, figures hold."""

import json
import re
import runpy

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.arithmetic import kernels
from p4dgs_ref.cli import parser as cli
from tests import ROOT
from tests.workshop import demo

PAGES = {
    name: (ROOT / name).read_text(encoding="utf-8")
    for name in (
        "README.md",
        "CONTRIBUTING.md",
        "tutorials/README.md",
        "tutorials/tour.md",
        "tutorials/reference.md",
        "p4dgs_ref/oracle/v1/README.md",
        "tests/workshop/README.md",
    )
}
README, REFERENCE = PAGES["README.md"], PAGES["tutorials/reference.md"]
PROGRAM = re.compile(r"```python\n((?:(?!```).)*)```\n```text\n(.*?)```", re.DOTALL)
PROGRAMS = {
    f"{name}, {i}": found
    for name, text in PAGES.items()
    for i, found in enumerate(PROGRAM.findall(text), 1)
}


# --- programs and commands ----------------------------------------------------------------------
@pytest.mark.filterwarnings("ignore:scene bouncing")  # a short training learns nothing
@pytest.mark.parametrize("place", PROGRAMS)
def test_a_program_prints_what_stands_below_it(place, tmp_path, capfd, monkeypatch):
    """One that trains `tiny` trains `smoke` here, which prints other numbers."""
    monkeypatch.chdir(ROOT)
    program, output = PROGRAMS[place]
    (tmp_path / "program.py").write_text(program.replace('"tiny"', '"smoke"'), encoding="utf-8")
    runpy.run_path(str(tmp_path / "program.py"), run_name="__main__")
    printed = capfd.readouterr()
    if '"tiny"' in program:
        printed, output = (re.sub(r"\d[\d,.]*", "N", text) for text in (printed.out, output))
        assert printed == output
    else:
        assert printed == (output, "")


@pytest.mark.parametrize("page", PAGES)
def test_commands_are_those_of_the_parser(page):
    for line in re.findall(r"p4dgs-ref ([a-z]+ [^`\n#]+)", PAGES[page]):
        words = [word for word in line.split() if word not in ("...", "…")]
        assert cli.parser().parse_args(words).function, f"{page}: p4dgs-ref {line}"


def test_one_equation_is_shown_as_its_file_has_it():
    file = ROOT / "p4dgs_ref" / "equations" / "offsets.py"
    body = file.read_text(encoding="utf-8").split("\n\n\n", 1)[1]
    shown = README.split("\n## One equation\n", 1)[1].split("```python\n", 1)[1].split("```", 1)[0]
    assert shown == body, "README, One equation: copy it from equations/offsets.py"


def test_the_scene_of_the_page_can_be_read(tmp_path):
    (text,) = re.findall(r"```json\n(.*?)```", REFERENCE, re.DOTALL)
    for split in ("train", "test"):
        (tmp_path / f"transforms_{split}.json").write_text(text, encoding="utf-8")
    (picture,) = (frame["file_path"] for frame in json.loads(text)["frames"])
    (tmp_path / picture).parent.mkdir()
    iio.imwrite(tmp_path / f"{picture}.png", np.zeros((6, 8, 3), np.uint8))
    (view,) = p4.load_scene(tmp_path).train
    assert np.allclose(view.camera.T, (0, 0, 4)) and view.time == 0  # the origin is before it


# --- links --------------------------------------------------------------------------------------
def anchors(text):
    """The anchors that GitHub gives to the headings of a page."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_lead_somewhere(page):
    links = re.findall(r"\]\(([^)\s]+)\)", PAGES[page])
    inside = [link.partition("#") for link in links if not link.startswith("https://")]
    assert inside, page
    for path, _, anchor in inside:
        target = ((ROOT / page).parent / path).resolve() if path else ROOT / page
        assert target.exists() and target.is_relative_to(ROOT), f"{page}: no {path}"
        if anchor and target.suffix == ".md":
            there = anchors(target.read_text(encoding="utf-8"))
            assert anchor in there, f"{page}: {path} has no heading #{anchor}"


def test_every_choice_that_the_code_cites_is_explained():
    files = (ROOT / "p4dgs_ref").rglob("*.py")
    cited = {n for f in files for n in re.findall(r"\bQ\d+\b", f.read_text(encoding="utf-8"))}
    explained = set(re.findall(r"^\| (Q\d+) \|", REFERENCE, re.MULTILINE))
    assert cited <= explained, f"tutorials/reference.md, Choices: no row of {cited - explained}"


# --- figures ------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def file():
    return (ROOT / "tutorials" / "demo.p4dgs").read_bytes()


@pytest.mark.parametrize("page", ["README.md", "tutorials/tour.md"])
def test_the_figures_of_the_demo_are_those_of_its_file(page, file):
    measured = p4.evaluate(p4.decode(file), p4.load_scene("bouncing"))[0]
    for words in (f"{len(file):,} bytes", f"{measured['psnr_db']:.1f} dB"):
        assert words in " ".join(PAGES[page].split()), f"{page}: the demo's file says {words}"


@pytest.mark.slow
def test_the_demo_gives_its_file_again(file):
    """`python -m tests.workshop.demo` keeps its hash, which every version of NumPy and SciPy gives.

    `.ci/run` runs this test with NumPy's lowest version, 2.0.2 and the newest.
    """
    kept = demo.kept()
    assert demo.sha256(file) == kept["tiny"], "tutorials/demo.p4dgs: make it with the demo"
    if not kept["arithmetic"].endswith(kernels()):
        pytest.skip(f"the demo had {kept['arithmetic']}; other kernels lead to another file")
    assert demo.sha256(demo.file()) == kept["tiny"], demo.with_what()
