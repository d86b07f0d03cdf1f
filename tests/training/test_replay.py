"""The published steps of a training: what a report of them says, and what they notice."""

from types import SimpleNamespace

import pytest

from p4dgs_ref import model
from p4dgs_ref.oracle import FolderPort, checker
from p4dgs_ref.oracle.report import as_json
from p4dgs_ref.splatting import render
from p4dgs_ref.training import density, objective, parameters, trainer
from tests.oracle.answers import Port, right, write
from tests.sampling import few
from tests.workshop import replay


def test_a_report_says_after_which_step_which_array_differs_first(tmp_path):
    """A port may leave out the subject, and some of its arrays; what it answers must be right."""
    shown = right("training_steps")
    for name in [name for name in shown if name.startswith(("growing/out.m_", "growing/out.v_"))]:
        del shown[name]
    (tmp_path / "right").mkdir()
    port = FolderPort(write(tmp_path / "right", training_steps=shown, training=right("training")))
    assert checker.check_port(port, ["L4"], ["training", "training_steps"]).ok
    late = [f"growing/out.{name}.{n}" for n in (2, 3) for name in replay.ARRAYS[1:]]
    wrong = shown | {name: shown[name] + 1 for name in late}
    report = checker.check_port(FolderPort(write(tmp_path, training_steps=wrong)), only="inside")
    lines = str(report).split("growing: fail\n")[1].splitlines()
    assert lines[0].startswith("    after step 3: out.f_a.2[")
    assert lines[8] == f"    and {len(late) - 8} more tensors"
    first_wrong = {row["id"]: row["first"] for row in as_json(report)["cases"]}
    assert first_wrong["training_steps/growing"] == "out.f_a.2"


def halved(*arguments):
    return {name: bar / 2 for name, bar in render.backward(*arguments).items()}


WRONG = [
    (parameters, "BETA_1", 0.8),
    (trainer, "learning_rate_at", lambda _, first, *others: first),
    (trainer, "FIRST_STAGE", {}),
    (density, "MAX_LOG_SCALE", -2.0),
    (density, "judged_children", lambda statistics, _: statistics.seen >= 0),
    (model, "LATTICE", 2**15 - 1),
    (objective, "render", SimpleNamespace(forward=render.forward, backward=halved)),
]


@pytest.mark.parametrize("module, name, wrong", few(WRONG, 1), ids=[row[1] for row in WRONG])
def test_a_wrong_rule_of_training_is_noticed(monkeypatch, module, name, wrong):
    monkeypatch.setattr(module, name, wrong)
    assert not checker.check_port(Port(), ["L4"], ["training"]).ok
