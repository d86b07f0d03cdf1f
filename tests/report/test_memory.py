"""No valid file costs a command more memory than the format page lets a decoder need."""

import subprocess
import sys

import numpy as np
import pytest

from p4dgs_ref.codec.file import encode
from p4dgs_ref.equations.prior import layout
from p4dgs_ref.model import Anchors, Design, Model, bounding_box
from tests.codec import fuzz

LEVELS = (("xyz", 65536),) * 64
# Models that cost most for the size of their files: the commands that need most memory for them,
# their anchors and their fields.
WORST = {
    "wide features": ("inspect", 900, dict(d=4096)),
    "many children": ("inspect render evaluate", 1000, dict(k=256)),
    "large grid": ("inspect view", 2, dict(grid=(("xyz", 161),), table=(2**24, 1))),
    "64 levels": ("inspect", 20_000, dict(grid=LEVELS, table=(1024, 1))),
    "64 large levels": ("inspect", 20_000, dict(grid=LEVELS, table=(65536, 1))),
    "deep context": ("inspect", 60_000, dict(context=(128,) * 8)),
    "many anchors": ("decode render", 150_000, {}),
    "large networks": ("decode", 30, dict(hidden=(900, 1100))),
}
COMMANDS = {
    "decode": "decode {} -o arrays",
    "inspect": "inspect {}",
    "view": "view {} -o page.html",
    "render": "render {} -o frames --frames 1 --size 64",
    "evaluate": "evaluate {} bouncing --downscale 8",
}
# Prints how many bytes of memory a command needs beside those that its modules need. The peak that
# getrusage returns would begin at the peak of the tests, which start the command.
PEAK = """
import re, sys
from pathlib import Path
import p4dgs_ref
p4dgs_ref.prepare()
from p4dgs_ref.cli import job, parser

def peak():
    status = Path("/proc/self/status").read_text()
    return 1024 * int(re.search(r"VmHWM:\\s+(\\d+) kB", status)[1])

before = peak()
assert parser.run(sys.argv[1:], 0.0) == 0
print("\\n", peak() - before)
"""


def almost_certain(A, **fields):
    """A model of A anchors whose numbers are 0 and cost next to no bits: its file is small."""
    usual = dict(d=1, k=1, hidden=(), deformation=(), L_x=1, L_t=1, context=(), F=1)
    rest = dict(table=(1, 1), grid=(("xy", 1),), Q_0=(1.0,) * 4, tau_alpha=0.0, effects=())
    design = Design(**{**usual, **rest, **fields})
    networks = {
        name: ([np.full(pair, 2.0**-20) for pair in pairs], [np.ones(J) for _, J in pairs])
        for name, pairs in design.layers().items()
    }
    _, deviations = layout(design.widths)
    networks["psi_p"][0][-1][:], networks["psi_p"][1][-1][deviations] = 0, -14
    grids = [np.ones(shape) for shape in design.levels()]
    grids[0].flat[0] = -1
    x_a = np.stack(np.unravel_index(np.arange(A), (256, 256, 256)), axis=1)[:, ::-1] / 255
    zeros = [np.zeros((A, *shape)) for shape in ((design.d,), (3,), (3,), (design.k, 3))]
    anchors = Anchors(x_a, *zeros, np.ones((A, design.k), bool))
    return Model(design, anchors, networks, grids, bounding_box(x_a), np.zeros(3))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory from /proc")
@pytest.mark.parametrize("name", WORST)
def test_no_command_needs_more_memory_than_a_decoder(name, tmp_path):
    """A picture needs all Gaussians at once, at most 1 KiB each beside the decoder's memory."""
    names, anchors, fields = WORST[name]
    data = encode(almost_certain(anchors, **fields))
    (tmp_path / "worst.p4dgs").write_bytes(data)
    bound = fuzz.memory_bound(data) + len(data)
    for line in map(COMMANDS.get, names.split()):
        command = [sys.executable, "-c", PEAK, *line.format("worst.p4dgs").split()]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, f"{line}: {done.stderr}"
        needed = int(done.stdout.split()[-1])
        draws = line.startswith(("render", "evaluate"))
        most = bound + 1024 * anchors * fields.get("k", 1) * draws
        assert 0 < needed <= most, f"{line}: {needed >> 20} MiB, expected at most {most >> 20}"
