"""What version 1.0 promises, as `promise.json` lists it, is here unchanged; more may be here.

The list is never edited. A later version may add names, commands, options, cases and streams; what
it removes or changes of the list makes it version 2.
"""

import hashlib
import json
from inspect import signature

import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import job
from p4dgs_ref.cli.parser import parser
from p4dgs_ref.oracle import published, streams
from tests import ROOT
from tests.cli.conftest import command, subcommands

PROMISE = json.loads((ROOT / "tests" / "promise.json").read_text(encoding="utf-8"))


def digest(parts):
    """The sha256 of arrays and of values that JSON can hold, in their order."""
    found = hashlib.sha256()
    for part in parts:
        if hasattr(part, "tobytes"):
            found.update(f"{part.dtype.str} {part.shape}".encode() + part.tobytes())
        else:
            found.update(json.dumps(part, sort_keys=True).encode())
    return found.hexdigest()


def of_vectors(promised):
    """Of all promised cases: settings, whether other answers pass, tolerances, tensors."""
    for subject, names in promised.items():
        cases = {case.name: case for case in published.cases(subject)}
        for case in map(cases.get, names):
            yield [case.id, case.record["settings"], case.record["result"]]
            for precision in ("float64", "float32"):
                tolerance = case.tolerance(precision)
                yield tolerance and tolerance["eps_S"]
            for name, array in case.tensors.items():
                yield name
                yield array


def of_streams(promised):
    """Of all promised streams: their bytes, and the numbers to which the valid ones decode."""
    rows = {row["name"]: row for row in published.stream_rows()}
    for row in map(rows.get, promised):
        yield [row["name"], (streams.STREAMS / row["file"]).read_bytes().hex()]
        for entry in row.get("arrays", ()):
            yield entry["name"]
            yield streams.stored(row, entry)


def options_of(entry):
    """{option or argument: its default value} of a command."""
    own = [action for action in entry._actions if action.dest != "help"]
    return {" ".join(action.option_strings) or action.dest: action.default for action in own}


def commands():
    """{command: its options}; those of `oracle` have names of two words."""
    found = {}
    for name, entry in subcommands(parser()).items():
        parts = {f"{name} {part}": one for part, one in subcommands(entry).items()}
        found |= {key: options_of(one) for key, one in (parts or {name: entry}).items()}
    return found


def test_vectors():
    assert digest(of_vectors(PROMISE["cases"])) == PROMISE["vectors sha256"]


def test_streams():
    """That the codec decodes them to these numbers is tested with the oracle."""
    assert digest(of_streams(PROMISE["streams"])) == PROMISE["streams sha256"]


def parameters(value):
    """The parameters of a public function or class; none of another value."""
    return [*signature(value).parameters] if callable(value) else []


def test_names_and_parameters():
    for name, promised in PROMISE["names"].items():
        assert name in p4.__all__
        assert parameters(getattr(p4, name))[: len(promised)] == promised, name


def test_commands_and_options():
    here, missing = commands(), object()
    for name, promised in PROMISE["commands"].items():
        options = {key: here[name].get(key, missing) for key in promised}
        assert options == promised, name


def interrupt(arguments):
    raise KeyboardInterrupt


def broken(arguments):
    raise ArithmeticError("step 3: NaN in opacity")


@pytest.mark.parametrize(
    "line, instead, meaning",
    [
        ("presets", None, "success"),
        ("oracle check .", None, "failed check or training"),  # a folder without answers
        ("presets", broken, "failed check or training"),
        ("decode missing.p4dgs -o arrays", None, "invalid input"),
        ("presets", interrupt, "interrupted"),
    ],
)
def test_exit_codes(line, instead, meaning, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    if instead:
        monkeypatch.setattr(job, "presets", instead)
    assert command(line) == PROMISE["exit codes"][meaning]
