"""The published steps of a training: what a report of them says, and what they notice."""

from p4dgs_ref.oracle import FolderPort, checker
from p4dgs_ref.oracle.report import as_json
from tests.oracle.answers import right, write
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
