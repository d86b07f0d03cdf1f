"""Every file that a header allows can be used: random valid headers through six commands."""

import warnings

import numpy as np
import pytest

from p4dgs_ref.codec.container import BitstreamError, write_container
from p4dgs_ref.codec.file import sections_of
from p4dgs_ref.codec.header import AXES, FIELDS
from p4dgs_ref.codec.plain import MAX_BOX
from p4dgs_ref.limits import MAX_OF
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from tests.sampling import few
from tests.workshop.conformance_good import LARGEST, Parts

SIZES = 0, 2.0**-1074, 2.0**-100, 0.3, 1, 2.0**20, 2.0**100, 1e300
NUMBERS = [*SIZES, *(-size for size in SIZES)]
COMMANDS = (
    "decode f.p4dgs -o decoded",
    "render f.p4dgs -o drawn --frames 2 --size 16",
    "render f.p4dgs -o of_scene --scene scene",
    "evaluate f.p4dgs scene --json",
    "inspect f.p4dgs",
    "view f.p4dgs",
)


def is_allowed(name, value):
    """Whether a header may hold this value."""
    try:
        FIELDS[name](name, value)
    except BitstreamError:
        return False
    return True


def random_file(seed):
    """A valid file whose header is drawn from all that its reader allows, within small sizes."""
    rng = np.random.default_rng(seed)

    def whole(most):
        return int(most ** rng.random())

    def widths():
        return tuple(whole(16) for _ in range(rng.integers(0, 4)))

    def number(name, wrap=lambda value: value):
        return float(rng.choice([v for v in NUMBERS if is_allowed(name, wrap(float(v)))]))

    fields = dict(
        anchors=whole(20),
        d=whole(32),
        k=whole(8),
        hidden=widths(),
        deformation=widths(),
        L_x=whole(MAX_OF["L_x"]),
        L_t=whole(MAX_OF["L_t"]),
        context=widths(),
        grid=tuple((str(rng.choice(AXES)), whole(2**16)) for _ in range(whole(4))),
        table=(whole(256), whole(256)),
        F=whole(8),
        Q_0=tuple(number("Q_0", lambda v: [v] * 4) for _ in range(4)),
        tau_alpha=number("tau_alpha"),
        effects=tuple(map(str, rng.permutation(MODEL_EFFECTS)[: rng.integers(0, 8)])),
    )
    parts = Parts(seed, **fields)
    if rng.random() < 0.5:  # the largest weights
        for W in [W for weights, _ in parts.networks.values() for W in weights]:
            W[...] = np.where(W < 0, -LARGEST, LARGEST)
    if rng.random() < 0.5:  # the largest box
        corner = np.full(3, np.nextafter(np.float32(MAX_BOX), np.float32(0)))
        parts.box = -corner, corner
    quantised = parts.quantised()
    color = [number("background", lambda v: [v] * 3) for _ in range(3)]
    quantised.model.background[...] = color
    return write_container(sections_of(quantised))


@pytest.mark.parametrize("seed", few(range(150), 3, 20))
def test_every_command_takes_a_valid_file(run, scene, tmp_path, monkeypatch, seed):
    (tmp_path / "f.p4dgs").write_bytes(random_file(seed))
    (tmp_path / "scene").symlink_to(scene)
    monkeypatch.chdir(tmp_path)
    for line in COMMANDS:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            code, _, err = run(line)
        assert code == 0, (line, err)
