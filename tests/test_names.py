"""A name in backquotes, in a page or a docstring, is a name of this project."""

import re

from tests import ROOT

PROSE = re.compile(r'"""(?:.|\n)*?"""|#.*')  # docstrings and comments
CLASS = re.compile(r"^class (\w+)(.*?)(?=^[^\s)]|\Z)", re.MULTILINE | re.DOTALL)
# What has an underscore or a capital, what is called, and a member of a class or module.
NAME = re.compile(
    r"`(\w*[A-Za-z]_\w+|(?:[A-Z][a-z]+)+|\w+(?=\()|[A-Za-z_]\w*\.[A-Za-z]\w*)(\([^`]*\))?`"
)
LETTER = re.compile(r"[A-Za-z]_[A-Za-z]")  # of the paper, with its index
FOLDERS = ("p4dgs_ref", "tests", "tiny_scenes", "tutorials")


def test_names_in_backquotes_exist():
    """Where it fails, mend the sentence: the name was changed or has gone."""
    files = [file for folder in FOLDERS for file in (ROOT / folder).rglob("*.*")]
    files += ROOT.glob("*.*")
    pages = [file for file in files if file.suffix == ".md"]
    words, prose = {}, {page: page.read_text(encoding="utf-8") for page in pages}
    for file in (file for file in files if file.suffix == ".py"):
        text = file.read_text(encoding="utf-8")
        code = PROSE.sub("", text)
        for owner, body in [(file.stem, code), *CLASS.findall(code)]:
            words.setdefault(owner, set()).update(re.findall(r"\w+", body))
        prose[file] = "\n".join(PROSE.findall(text))
    del prose[ROOT / "CHANGELOG.md"]  # which names what has gone
    manifest = (ROOT / "p4dgs_ref" / "oracle" / "v1" / "manifest.json").read_text(encoding="utf-8")
    known = {*words, *re.findall(r"\w+", manifest), *(file.stem for file in files)}
    known = known.union(*words.values())
    endings = {"npz", *(file.suffix[1:] for file in files)}  # of files, which `train` writes too
    wrong = []
    for place, text in prose.items():
        for name in (match[1] for match in NAME.finditer(text) if not LETTER.fullmatch(match[1])):
            owner, _, member = name.partition(".")
            exists = owner in known and (not member or member in words.get(owner, known))
            if not exists and member not in endings:
                wrong.append(f"{place.relative_to(ROOT)}: `{name}`")
    assert not wrong, "\n".join(["nothing has these names:", *wrong])
