"""What version 1.0 promises, as `promise.json` lists it, is here unchanged; more may be here.

The list is never edited. A later version may add names, commands, options, cases and streams; what
it removes or changes of the list makes it version 2.
"""

import hashlib
import json
import re
import sys
from inspect import signature
from itertools import takewhile, zip_longest
from types import FunctionType

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref import oracle
from p4dgs_ref.arithmetic import PROMISED
from p4dgs_ref.cli import job
from p4dgs_ref.cli.parser import parser
from p4dgs_ref.oracle import compare, published, streams
from p4dgs_ref.oracle.adapter import Adapter
from tests import ROOT
from tests.cli.conftest import command, subcommands
from tests.oracle.answers import right, write

ONLY = "--only rate_loss/ordinary --only rate_loss/by_hand"
PROMISE = json.loads((ROOT / "tests" / "promise.json").read_text(encoding="utf-8"))


def digest(*parts):
    """Twelve digits of the sha256 of values: arrays, bytes, and what JSON can hold."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            part = f"{part.dtype.str} {part.shape}".encode() + part.tobytes()
        elif not isinstance(part, bytes):
            part = json.dumps(part, sort_keys=True).encode()
        found.update(part)
    return found.hexdigest()[:12]


def in_order(arrays):
    """The names and arrays of a dictionary, one after the other, by name."""
    return [part for pair in sorted(arrays.items()) for part in pair]


# --- the vectors and the format ---
def digests(case):
    """{what is promised of a case: its digest}."""
    subject = published.subjects()[case.subject]
    tolerances = [case.record["tolerance"], case.record["result"], case.record.get("others")]
    tolerances += [subject.get("group"), subject["level"], subject["equation"]]
    for precision in compare.PRECISIONS:
        tolerances += in_order(compare.printed_arrays().get((case.id, precision), {}))
    return {
        "settings": digest(case.record["settings"], subject["shapes"], subject["differentiable"]),
        "tolerances, or what else may be answered,": digest(*tolerances),
        "tensors": digest(*in_order(case.tensors)),
    }


@pytest.mark.parametrize("subject", PROMISE["vectors"])
def test_vectors(subject):
    assert subject in published.subjects(), f"{subject}: the subject is gone"
    cases = {case.name: case for case in published.cases(subject)}
    for name, promised in PROMISE["vectors"][subject].items():
        assert name in cases, f"{subject}/{name}: the case is gone"
        for (what, found), expected in zip(digests(cases[name]).items(), promised):
            assert found == expected, f"{subject}/{name}: its {what} are others than in 1.0"


def stream_digest(row):
    """The digest of a stream: its bytes, and what a decoder finds, or that it is refused."""
    found = {entry["name"]: streams.read_expected(row, entry) for entry in row.get("arrays", ())}
    data = (streams.STREAMS / row["file"]).read_bytes()
    return digest(row["result"], data, *in_order(found))


@pytest.mark.parametrize("name", PROMISE["streams"])
def test_streams(name):
    """That the codec decodes them to these numbers is tested with the oracle."""
    rows = {row["name"]: row for row in published.stream_rows()}
    assert name in rows, f"codec/{name}: the stream is gone"
    message = f"codec/{name}: its bytes, numbers or verdict are others than in 1.0"
    assert stream_digest(rows[name]) == PROMISE["streams"][name], message


# --- names and parameters ---
def parameters(value):
    """The parameters of a function or class as in its `def`; none of other values and exceptions.

    A default that has a name is shown by it, as the renderer's settings, or as "function".
    """
    shown, by_name = [], False
    try:
        found = signature(value).parameters.values() if callable(value) else ()
    except ValueError:  # an exception of one text
        found = ()
    for p in found:
        is_function = isinstance(p.default, FunctionType)
        default = "function" if is_function else getattr(p.default, "name", p.default)
        text = str(p.replace(annotation=p.empty, default=default))
        if p.kind is p.KEYWORD_ONLY and not by_name:
            shown.append("*")
            by_name = True
        shown.append(text)
    return shown


def public(name):
    """The value of a dotted public name; of a table, one of its entries."""
    value = p4
    for part in name.split("."):
        if value in (p4, oracle):
            assert part in value.__all__, f"{name}: it is no public name any more"
        is_table = isinstance(value, dict)
        value = value.get(part) if is_table else getattr(value, part, None)
        assert value is not None, f"{name}: it is gone"
    return value


@pytest.mark.parametrize("name", PROMISE["names"])
def test_names_and_parameters(name):
    """New parameters follow the old ones, have defaults, or are given by name."""
    here, promised = parameters(public(name)), PROMISE["names"][name]
    by_position = [*takewhile(lambda text: text[0] != "*", promised)]
    for text, found in zip_longest(by_position, here[: len(by_position)]):
        assert found == text, f"{name}: the parameter {found}, promised {text}"
    for text in promised:
        assert text in here, f"{name}: the parameter {text} is promised, here are {here}"
    for text in here:
        assert text in promised or "=" in text or text[0] == "*", (
            f"{name}: the parameter {text} has no default"
        )


# --- the command line ---
def option_of(action):
    """What is promised of an option or argument.

    A default that only the help names is tested in tests/cli/test_arguments.py.
    """
    named = re.search(r"\(default (\S+)\)", action.help or "")
    default = named[1] if action.default is None and named else action.default
    promised = {"default": default, "nargs": action.nargs, "choices": action.choices}
    promised["required"] = action.required or None
    return {name: value for name, value in promised.items() if value is not None}


def options_of(entry):
    """{option or argument: what is promised of it} of a command."""
    own = [action for action in entry._actions if action.dest != "help"]
    return {" ".join(action.option_strings) or action.dest: option_of(action) for action in own}


def commands():
    """{command: its parser}; those of `oracle` have names of two words."""
    found = {}
    for name, entry in subcommands(parser()).items():
        parts = {f"{name} {part}": one for part, one in subcommands(entry).items()}
        found |= parts or {name: entry}
    return found


@pytest.mark.parametrize("name", PROMISE["commands"])
def test_commands_and_options(name):
    """The options of some commands may change: for these the list says null."""
    assert name in commands(), f"{name}: the command is gone"
    here, promised = options_of(commands()[name]), PROMISE["commands"][name]
    for option, expected in (promised or {}).items():
        assert option in here, f"{name} {option}: it is gone"
        found = json.loads(json.dumps(here[option]))
        assert found == expected, f"{name} {option}: default, choices or number of values"
    for option in here:
        if promised is not None and option not in promised:
            assert "required" not in here[option], f"{name} {option}: a new option is required"


ENDS_OF_RANGES = [
    (name, option, text)
    for name, options in PROMISE["values"].items()
    for option, texts in options.items()
    for text in texts
]


@pytest.mark.parametrize("name, option, text", ENDS_OF_RANGES)
def test_values_that_options_take(name, option, text):
    """What is beyond the ends of a range may be taken later."""
    (action,) = (a for a in commands()[name]._actions if option in a.option_strings)
    action.type(text)  # raises ArgumentTypeError


# --- exit codes ---
def interrupt(arguments):
    raise KeyboardInterrupt


def broken(arguments):
    raise ArithmeticError("step 3: NaN in opacity")


@pytest.fixture
def answers(tmp_path, monkeypatch):
    """Folders of answers: `right`, `partly`, in which one of two is wrong, and `none`."""
    for name in ("right", "partly", "none"):
        (tmp_path / name).mkdir()
    kept, wrong = right("rate_loss"), "by_hand/out.L_rate"
    write(tmp_path / "right", rate_loss=kept)
    write(tmp_path / "partly", rate_loss=kept | {wrong: kept[wrong] + 1})
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("answers")
@pytest.mark.parametrize(
    "line, instead, meaning",
    [
        ("presets", None, "success"),
        (f"oracle check right {ONLY}", None, "success"),
        (f"oracle check partly {ONLY}", None, "failed check or training"),
        ("oracle check right --level L1", None, "failed check or training"),
        ("oracle check none", None, "failed check or training"),
        ("presets", broken, "failed check or training"),
        ("decode missing.p4dgs -o arrays", None, "invalid input"),
        ("oracle check", None, "invalid input"),
        ("oracle check right --dtype float16", None, "invalid input"),
        ("presets", interrupt, "interrupted"),
    ],
)
def test_exit_codes(line, instead, meaning, monkeypatch):
    if instead:
        monkeypatch.setattr(job, "presets", instead)
    try:
        code = command(line)
    except SystemExit as stopped:  # argparse refuses the line
        code = stopped.code
    assert code == PROMISE["exit codes"][meaning], f"the exit code of `{line}`"


# --- the oracle for other languages ---
def agree(found, promised, place):
    """Compare JSON values; "..." stands for any text, and `found` may have more keys."""
    if isinstance(promised, dict):
        for key, value in promised.items():
            assert key in found, f"{place}: the key {key!r} is gone"
            agree(found[key], value, f"{place}, {key!r}")
    elif isinstance(promised, list) and len(promised) == len(found):
        for i, value in enumerate(promised):
            agree(found[i], value, f"{place}[{i}]")
    else:
        as_any = promised == "..." and isinstance(found, str)
        assert as_any or found == promised, f"{place}: {found!r}, promised {promised!r}"


@pytest.mark.usefixtures("answers")
def test_json_of_a_check(capsys):
    """Of a folder in which one of two answers is wrong."""
    command(f"oracle check partly {ONLY} --json")
    agree(json.loads(capsys.readouterr().out), PROMISE["check --json"], "oracle check --json")


# A port that answers as the promise says, and keeps what it was asked.
PORT = """
import json, sys
answers = json.load(open(sys.argv[1]))
for line in sys.stdin:
    open(sys.argv[2], "a").write(line)
    print(json.dumps(answers[json.loads(line).get("id", "first line")]), flush=True)
"""


@pytest.mark.parametrize("dtype", PROMISE["protocol"])
def test_protocol_of_the_adapter(dtype, tmp_path):
    """Every line to the port, and what each of its answers counts as."""
    script, given, asked = (tmp_path / name for name in ("port.py", "answers", "asked"))
    script.write_text(PORT, encoding="utf-8")
    rows = PROMISE["protocol"][dtype]
    lines = {row["id"]: row["answer"] for row in rows if "request" in row}
    given.write_text(json.dumps(lines), encoding="utf-8")
    line = [*map(str, (sys.executable, "-S", script, given, asked))]
    with Adapter(line, timeout=60, dtype=dtype) as port:
        report = oracle.check_port(port, only=[row["id"] for row in rows[1:]])
    requests = [json.loads(text) for text in asked.read_text(encoding="utf-8").splitlines()]
    agree(requests, [row["request"] for row in rows if "request" in row], "lines to the port")
    verdicts = {result.id: result.verdict for result in report.results}
    agree(verdicts, {row["id"]: row["verdict"] for row in rows[1:]}, "verdicts on its answers")


# --- one arithmetic ---
def test_one_arithmetic():
    """The demo is made again in the slow lane; here its file and the kernels' name are compared."""
    promised = PROMISE["arithmetic"]
    assert promised["kernels"] == PROMISED, "the kernels that prepare() chooses"
    data = (ROOT / "tutorials" / "demo.p4dgs").read_bytes()
    found = hashlib.sha256(data).hexdigest()
    assert found == promised["sha256 of demo.p4dgs"], "the file of the demo, tutorials/demo.p4dgs"
