"""The adapter's protocol against real processes: right ones, and ones that fail in every way."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref.oracle import adapter as adapter_module
from p4dgs_ref.oracle import checker, report
from p4dgs_ref.oracle.adapter import Adapter, AdapterError
from p4dgs_ref.oracle.ports import PortError
from p4dgs_ref.oracle.published import Golden
from tests.processes import alive, wait_until_gone
from tests.sampling import few

# A port of y = x. It answers case n rightly unless the lines that are put into it change that.
PORT = """
import json, os, signal, subprocess, sys, time
open({log!r}, "a").write(f"{{os.getpid()}}\\n")
def send(text):
    sys.stdout.write(text)
    sys.stdout.flush()
{start}
for n, text in enumerate(sys.stdin):
    request = json.loads(text)
    answer = {{"p4dgs_oracle": 1}}
    if "in" in request:
        answer = {{"id": request["id"], "out": {{"y": request["in"]["x"]}}}}
        answer["in_bar"] = {{"x": request["out_bar"]["y"]}}
    {twist}
    send(json.dumps(answer) + "\\n")
"""


class Port:
    """Makes adapters around the port above and knows which processes they started."""

    def __init__(self, folder):
        self.log, self.script = folder / "started", folder / "port.py"
        self.log.touch()

    def __call__(self, twist="pass", start="", **options):
        self.script.write_text(
            PORT.format(log=str(self.log), start=start, twist=twist.replace("\n", "\n    ")),
            encoding="utf-8",
        )
        self.adapter = Adapter(
            f"{shlex.quote(sys.executable)} -S {shlex.quote(str(self.script))}", **options
        )
        return self.adapter

    def pids(self):
        return [int(line) for line in self.log.read_text(encoding="utf-8").split()]


def here(twist):
    """An adapter with the same port in this process, whose n-th answer the twist may change."""
    made, count = Adapter(sys.executable), iter(range(1, 99))

    def exchange(line, _):
        request = json.loads(line)
        answer = {"id": request["id"], "out": {"y": request["in"]["x"]}}
        answer["in_bar"] = {"x": request["out_bar"]["y"]}
        names = {"answer": answer, "n": next(count), "json": json, "line": None}
        exec(twist, names)
        line = json.dumps(answer) if names["line"] is None else names["line"]
        return line if isinstance(line, bytes) else line.encode()

    made.child = SimpleNamespace(exchange=exchange, end=lambda grace: "its last words")
    return made, made.child


@pytest.fixture
def port(tmp_path):
    made = Port(tmp_path)
    yield made
    made.adapter.close()
    wait_until_gone(made.pids())


def case(name="0", subject="identity", x=None, **tensors):
    """A case of y = x as read from vectors."""
    x = np.array([[0.5, -1.25, 3e-310], [np.nan, np.inf, -0.0]]) if x is None else x
    bar, scale = np.random.default_rng(1).normal(size=x.shape), np.ones(x.shape, np.float32)
    record = {
        "id": f"{subject}/{name}",
        "name": name,
        "result": "valid",
        "settings": {"near": 0.2, "axes": "xy"},
        "tolerance": {"float64": {"eps_S": 32}, "float32": {"eps_S": 32}},
    }
    tensors = {
        "in.x": x,
        **tensors,
        "out_bar.y": bar,
        "out.y": x,
        "in_bar.x": bar,
        "scale.out.y": scale,
        "scale.in_bar.x": scale,
    }
    return Golden(record["id"], name, subject, "some_equation", "L1", record, tensors)


def verdicts(adapter, count=5, subject="identity"):
    """ok, or the kind of PortError, of some cases in a row."""
    return [verdict(adapter, case(str(i), subject)) for i in range(count)]


def verdict(adapter, asked):
    try:
        return "ok" if adapter.run(asked) else "empty"
    except PortError as error:
        return error.kind


def failure(adapter, asked=None):
    with pytest.raises(PortError) as caught:
        adapter.run(asked or case())
    assert "\n" not in str(caught.value)
    return caught.value.kind, str(caught.value)


def test_numbers_come_back_bit_for_bit_from_one_process(port):
    ask = port()
    for x in (
        case().tensors["in.x"],
        np.zeros((0, 3)),
        np.array(2.5),
        np.ones((2, 1, 3), np.float32),
        np.array([True, False]),
        np.array([[-(2**63), 2**63 - 1]]),
        np.array([7, 8], ">u2"),
        np.eye(2, 3).T,
        np.zeros((3, 0), np.float16),
        np.random.default_rng(2).normal(size=(500, 600)),
    ):  # more than a pipe holds
        got, dtype = ask.run(case(x=x)), "<f8" if x.dtype.kind == "f" else x.dtype.newbyteorder("<")
        assert set(got) == {"out.y", "in_bar.x"}
        assert (got["out.y"].dtype, got["out.y"].shape) == (dtype, x.shape)
        assert got["out.y"].tobytes() == x.astype(dtype).tobytes()
    assert len(port.pids()) == 1


def test_a_case_that_float32_cannot_hold_is_not_asked(port):
    asked = case()
    asked.record["tolerance"].update(float32=None, float32_reason="too large")
    assert failure(port(dtype="float32"), asked) == ("not_judged", "too large") and not port.pids()
    assert verdict(port(), asked) == "ok"


DEATHS = {
    "print('out of memory', file=sys.stderr); sys.exit(4)": "exit code 4; stderr: out of memory",
    "os.kill(os.getpid(), signal.SIGKILL)": "killed by signal 9",
    "send('{\"id\": '); sys.exit(0)": "exit code 0",
    "raise RuntimeError('no such kernel')": "RuntimeError: no such kernel",
    # The process that it started keeps its stdout.
    "os.close(2); subprocess.Popen(['sleep', '60']); sys.exit(5)": "exit code 5",
    "os.close(1); os.close(0); time.sleep(60)": "closed its pipes",
}


@pytest.mark.posix("ends processes by other means than signals")
@pytest.mark.parametrize("twist", few(DEATHS, 1))
def test_a_death_costs_one_case(port, twist):
    ask = port(f"if n == 3: {twist}", timeout=3.0)
    assert verdicts(ask, 2) == ["ok", "ok"]
    kind, message = failure(ask)
    assert kind == "died" and DEATHS[twist] in message
    assert verdicts(ask, 2) == ["ok", "ok"] and len(port.pids()) == 2


HANGS = [
    "if n == 2: time.sleep(60)",
    "if n == 2: send(json.dumps(answer)); time.sleep(60)",  # never ends its line
    "while n == 2: print('still at it', file=sys.stderr)",
    "if n == 2: subprocess.Popen(['sleep', '60']).wait()",
    "if n == 2: signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)",
]


@pytest.mark.slow
@pytest.mark.parametrize("twist", HANGS)
def test_a_port_that_hangs_is_stopped(port, twist):
    ask, started = port(twist, timeout=1.0), time.monotonic()
    assert verdicts(ask, 3) == ["ok", "hung", "ok"] and time.monotonic() - started < 5.5
    assert len(port.pids()) == 2 and not alive(port.pids()[0])


def test_a_request_that_nobody_reads_is_no_deadlock(port):
    ask = port("if n == 0: send(json.dumps(answer) + '\\n'); time.sleep(60)", timeout=1.0)
    assert failure(ask, case(x=np.ones((1000, 1000))))[0] == "hung"


# Starts a process that sleeps, and writes its number into a file.
SLEEPER = "open({!r}, 'a').write(str(subprocess.Popen(['sleep', '60']).pid) + '\\n')"


@pytest.mark.parametrize(
    "twist, words",
    [
        ("if n: print('warming up')", "'warming up"),
        ("if n == 0: answer = {'p4dgs_oracle': 2}", "expected p4dgs_oracle 1, got 2"),
        ("if n == 0: answer['subjects'] = ['ofsets']", "subjects: expected a list of some of tanh"),
        ("if n == 0: answer['subjects'] = 'offsets'", "subjects: expected a list"),
        ("if n: send(json.dumps(answer, indent=1) + '\\n'); continue", "object, got '{'"),
    ],
)
def test_a_log_or_another_version_is_named(port, twist, words):
    assert words in failure(port(twist))[1]


TWICE = [
    "if n: send(2 * (json.dumps(answer) + '\\n')); continue",
    "if n: send(json.dumps(answer) + '\\n')",
    "if n: send(json.dumps(answer) + '\\n'); time.sleep(0.05)",
]


@pytest.mark.parametrize("twist", TWICE)
def test_a_second_line_is_the_answer_to_the_next_request(port, twist):
    """However soon it comes."""
    assert verdicts(port(twist)) == ["ok", "nonsense"] * 2 + ["ok"]


def test_floods_are_bounded(port, monkeypatch):
    monkeypatch.setattr(adapter_module, "MAX_LINE_BYTES", 10**6)
    kind, message = failure(port("if n: send('x' * 2 * 10**6); time.sleep(60)"))
    assert kind == "nonsense" and "1,000,000 bytes" in message
    assert failure(port("while n: send('x\\n' * 65536)"))[0] == "nonsense"


# Lines after which the process may owe an answer, so it is not asked again.
LOST = {
    "line = 'loading the model'": "'loading the model",
    "line = '[1, 2]'": "expected a line with a JSON object",
    "line = ''": "got ''",
    'line = \'{"id": "identity/1"\'': "expected a line with a JSON object",
    "line = '\\udcff'.encode('utf-8', 'surrogateescape')": "xff",
    "line = '[' * 200000": "expected a line with a JSON object",
    "answer['id'] = 'identity/9'": "expected id",
    "del answer['id']": "expected id",
    "answer['id'] = None": "got null",
}
# Answers that cannot be read, but the lines are still in step, so the process goes on.
FIELDS = {
    "answer['out']['y']['data'] = 'AAA'": "out.y: expected data in base64",
    "answer['out']['y']['data'] = '!' * 64": "base64",
    "answer['out']['y']['data'] = 5": "base64",
    "answer['out']['y']['data'] = 'AAAA'": "48 bytes for F64 [2, 3], got 3",
    "answer['out']['y']['dtype'] = 'float64'": "out.y.dtype: expected one of F64",
    "answer['out']['y']['dtype'] = ['F64']": "out.y.dtype: expected one of F64",
    "answer['out']['y']['shape'] = [2, 2]": "32 bytes",
    "answer['out']['y']['shape'] = 6": "out.y.shape",
    "answer['out']['y']['shape'] = [-2, -3]": "out.y.shape",
    "answer['out']['y']['shape'] = [2.0, 3]": "out.y.shape",
    "answer['out']['y']['shape'] = [10**9, 10**9, 10**9]": "bytes for",
    "answer['out']['y']['shape'] = [0] * 99": "out.y.shape",
    "answer['out']['y'].update(dtype='BOOL', shape=[48])": "bytes 0 and 1",
    "answer['in_bar']['x'].update(dtype='F32', shape=[2, 6])": "in_bar.x: expected float64",
    "del answer['in_bar']['x']['shape']": "in_bar.x.shape: expected a list",
    "answer['out']['y'] = [1.0]": "out.y: expected the fields",
    "answer['out'] = [1.0]": "'out': expected an object of arrays",
    "del answer['in_bar']": "'in_bar': expected",
    "del answer['out']": "'out': expected an object of arrays",
}


@pytest.mark.parametrize("twist", [*LOST, *FIELDS])
def test_an_answer_that_cannot_be_read(twist):
    ask, child = here(f"if n == 2: {twist}")
    assert verdicts(ask, 1) == ["ok"]
    kind, message = failure(ask, case("1"))
    assert kind == "nonsense" and {**LOST, **FIELDS}[twist] in message and len(message) < 800
    if twist in LOST:
        assert ask.child is None and "stderr: its last words" in message
    else:
        assert verdicts(ask, 1) == ["ok"] and ask.child is child


def test_a_port_may_say_that_it_lacks_gradients_and_subjects(port):
    ask = port(
        "answer.pop('in_bar', None)\n"
        "if n == 0: answer.update(gradients=False, subjects=['offsets', 'codec'])"
    )
    cases = [case(*id, np.ones(3)) for id in (("0", "offsets"), ("1", "offsets"), ("0", "view"))]
    cases[1].tensors["out.y"] = np.zeros(3)
    results = checker.Report([checker.judge(asked, ask)[0] for asked in cases], ask.says)
    assert {r.verdict: r.required for r in results.results} == {
        "pass": True,
        "fail": True,
        "absent": False,
    }
    assert "only outputs were judged\nthe port lacks view; cases not asked: 1" in str(results)
    assert {"gradients": False, "lacking": ["view"]}.items() <= report.as_json(results).items()


def test_a_port_that_cannot_start_is_given_up(port):
    ask = port(start="sys.exit('no device')")
    assert verdicts(ask, 9) == ["died"] * 9 and len(port.pids()) == 3
    message = failure(ask)[1]
    assert message.startswith("not asked, after 3 failures in a row") and "no device" in message


def test_losses_with_answers_between_them_are_no_reason_to_give_up(port):
    ask = port("if n == 2: sys.exit(1)")
    assert [verdict(ask, case("0", subject)) for subject in "abcdefgh"] == ["ok", "died"] * 4


def test_a_subject_that_always_kills_costs_three_starts(port):
    ask = port("if n and request['subject'] == 'cursed': sys.exit(1)")
    assert verdicts(ask, 2) == ["ok"] * 2
    assert verdicts(ask, 9, "cursed") == ["died"] * 9 and len(port.pids()) == 3
    assert verdicts(ask, 2) == ["ok"] * 2 and len(port.pids()) == 4
    ask.close()
    port.log.write_text("", encoding="utf-8")
    ask = port("if n: sys.exit(1)")  # but of three subjects in a row, none is asked any more
    assert [verdict(ask, case("0", subject)) for subject in "abcdefgh"] == ["died"] * 8
    assert len(port.pids()) == 3


@pytest.mark.parametrize("command", ["no-such-port --fast", "python 'x", " "])
def test_a_command_that_is_none(command):
    with pytest.raises(AdapterError, match="expected a command"):
        Adapter(command)


@pytest.mark.parametrize(
    "sep, text, words",
    [
        ("/", r"my\ port 'a b'", ["my port", "a b"]),
        ("\\", r'C:\env\python.exe "a b\c"', [r"C:\env\python.exe", r"a b\c"]),
    ],
)
def test_backslashes_of_a_command(monkeypatch, sep, text, words):
    monkeypatch.setattr(adapter_module.os, "sep", sep)
    assert adapter_module.words_of(text) == words


@pytest.mark.posix("has no groups of processes")
def test_a_process_that_leaves_the_group_and_holds_the_pipes_costs_little(port, tmp_path, capfd):
    twist = (
        "if n: child = subprocess.Popen(['sleep', '60'], start_new_session=True); "
        f"open({str(tmp_path / 'left')!r}, 'w').write(str(child.pid)); time.sleep(60)"
    )
    ask, start = port(twist, timeout=0.5), time.monotonic()
    assert verdicts(ask, 1) == ["hung"] and time.monotonic() - start < 5
    os.kill(int((tmp_path / "left").read_text(encoding="utf-8")), signal.SIGKILL)
    time.sleep(0.1)  # now threads read the end of the pipes
    assert capfd.readouterr().err == ""


@pytest.mark.posix("has no groups of processes")
def test_nothing_that_a_port_started_outlives_it(port, tmp_path):
    ask = port(start=SLEEPER.format(str(tmp_path / "started")))
    assert verdicts(ask, 1) == ["ok"]
    ask.close()
    assert len(port.pids()) == 2
    wait_until_gone(port.pids())


@pytest.mark.posix("has no groups of processes")
def test_stopping_the_checker_stops_the_port(port, tmp_path):
    """Ctrl-C while the port and a process that it started are at work."""
    port(f"if n: {SLEEPER.format(str(port.log))}; time.sleep(60)")
    script = (
        "from p4dgs_ref.oracle.adapter import Adapter\nimport signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with Adapter(sys.argv[1]) as ask:\n    ask.decode('full', b'')\n"
    )
    checker = subprocess.Popen(
        [sys.executable, "-c", script, shlex.join(port.adapter.command)], stderr=subprocess.PIPE
    )
    end = time.monotonic() + 30
    while len(port.pids()) < 2:
        assert checker.poll() is None and time.monotonic() < end
        time.sleep(0.02)
    checker.send_signal(signal.SIGINT)
    assert b"KeyboardInterrupt" in checker.communicate(timeout=30)[1]
    wait_until_gone(port.pids())
