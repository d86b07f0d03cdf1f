"""The benchmark: what its rows say, and the command that prints it."""

from functools import partial

import pytest

from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.lab import __main__ as command
from p4dgs_ref.lab import bench


@pytest.mark.slow
def test_the_command_prints_what_was_measured(capsys, monkeypatch):
    measured = bench.bench(quick=True)
    assert measured["arithmetic"] == arithmetic()
    rows = {row["what"]: row for row in measured["rows"]}
    assert rows["render 300 Gaussians, 64x64, with gradients"]["ratio"] > 1
    assert rows["training step of `tiny`, stage 4"]["ms"] > rows["  compositing, fast"]["ms"] > 0
    monkeypatch.setattr(bench, "bench", partial(dict, measured))
    command.main()
    assert capsys.readouterr().out == bench.to_text(measured) + "\n"
