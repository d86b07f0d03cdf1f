"""Every default that the help of a command names is what happens without the option."""

import re

import numpy as np
import pytest

from p4dgs_ref.cli import UsageError, oracle
from p4dgs_ref.cli.parser import parser
from p4dgs_ref.model import Model
from tests.cli.conftest import subcommands

# Commands that choose a default themselves, because an option that is given means something else.
LINES = {
    "render": "render bouncing.p4dgs -o {}",
    "oracle check": "oracle check --adapter port",
}


def named(table, path=""):
    """(command, option, value in the help, default of the parser) of all options."""
    for name, entry in subcommands(table).items():
        yield from named(entry, f"{path} {name}".strip())
    for action in table._actions:
        if found := re.search(r"\(default (\S+)\)", action.help or ""):
            yield path, action.option_strings[-1], found[1], action.default


ALL = [*named(parser())]


@pytest.mark.parametrize("command, option, value, default", ALL)
def test_the_parser_has_the_default_of_the_help(command, option, value, default):
    chosen = command in LINES and default is None
    assert chosen or str(default) == value, f"{command} {option}: the help says (default {value})"


@pytest.mark.parametrize("command, option, value", [row[:3] for row in ALL if row[3] is None])
def test_a_command_chooses_the_default_of_the_help(
    run, trained, tmp_path, monkeypatch, command, option, value
):
    """With the value of the help a command does what it does without the option."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bouncing.p4dgs").write_bytes(trained.data)
    seen = []

    def render(self, camera, t, *others):
        seen.append(f"{camera}, t={t}")
        return np.zeros((2, 2, 3))

    def adapter(_, timeout, dtype):
        seen.append(f"timeout {timeout}, dtype {dtype}")
        raise UsageError("seen")

    monkeypatch.setattr(Model, "render", render)
    monkeypatch.setattr(oracle, "Adapter", adapter)
    run(LINES[command].format("without"))
    without, seen[:] = [*seen], []
    run(f"{LINES[command].format('with')} {option} {value}")
    assert seen and seen == without, f"{command} {option}: the help says (default {value})"
