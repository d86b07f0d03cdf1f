"""PLY files of Gaussians as 3DGS stores them: the bytes, the way there and back, hard cases."""

import math
import struct

import numpy as np
import pytest

from p4dgs_ref.model import Gaussians
from p4dgs_ref.report.splats import write_gaussians
from p4dgs_ref.scenes import SceneError
from p4dgs_ref.scenes.files import read_points
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import EXACT, FAST
from tests.codec.models import read_gaussians

CAMERA = look_at((3.0, 1.0, 1.5), (0, 0, 0), 60.0, 55.0, 40, 32)
STANDARD = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
)


def some(n, seed=0):
    rng = np.random.default_rng(seed)
    r = rng.normal(size=(n, 4))
    return Gaussians(
        x=rng.uniform(-0.6, 0.6, (n, 3)),
        s=rng.uniform(0.02, 0.3, (n, 3)),
        r=r / np.linalg.norm(r, axis=1, keepdims=True),
        alpha=rng.uniform(0, 1, n),
        color=rng.uniform(0, 1, (n, 3)),
        index=np.arange(n),
    )


def picture(gaussians, settings=EXACT):
    out, _ = render.forward(*gaussians[:5], CAMERA, np.ones(3), settings, keep=False)
    return out[0]


def by_hand(path):
    """The header's lines and the vertices as tuples of 17 numbers, without NumPy."""
    head, body = path.read_bytes().split(b"\nend_header\n", 1)
    return head.decode("ascii").splitlines(), list(struct.iter_unpack("<17f", body))


def test_the_file_is_the_one_that_viewers_know(tmp_path):
    gaussians = some(5)
    write_gaussians(tmp_path / "a.ply", gaussians, ["time 0.5"])
    lines, rows = by_hand(tmp_path / "a.ply")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2:4] == ["comment time 0.5", "element vertex 5"]
    assert lines[4:] == [f"property float {name}" for name in STANDARD.split()]
    for row, x, s, r, alpha, color, _ in zip(rows, *gaussians, strict=True):
        assert row[:3] == pytest.approx(x, rel=1e-6) and row[3:6] == (0, 0, 0)
        y00 = 1 / (2 * math.sqrt(math.pi))
        assert [0.5 + y00 * f for f in row[6:9]] == pytest.approx(color, abs=1e-6)
        assert 1 / (1 + math.exp(-row[9])) == pytest.approx(alpha, abs=1e-6)
        assert [math.exp(a) for a in row[10:13]] == pytest.approx(s, rel=1e-6)
        assert row[13:] == pytest.approx(r, abs=1e-6)


def test_there_and_back(tmp_path):
    gaussians = some(50)
    write_gaussians(tmp_path / "a.ply", gaussians)
    again = read_gaussians(tmp_path / "a.ply")
    for name, before, after in zip(Gaussians._fields, gaussians, again):
        np.testing.assert_allclose(after, before, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(picture(again), picture(gaussians), atol=2e-5)
    np.testing.assert_allclose(picture(again, FAST), picture(gaussians, FAST), atol=2e-5)
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply"), again.x)
    write_gaussians(tmp_path / "b.ply", again)
    third = read_gaussians(tmp_path / "b.ply")
    np.testing.assert_allclose(third.alpha, again.alpha, rtol=1e-5, atol=1e-7)


HARD = {
    "opaque": lambda g: g._replace(alpha=np.ones(len(g.x))),
    "almost opaque": lambda g: g._replace(alpha=np.full(len(g.x), 1 - 2**-53)),
    "at the clamp": lambda g: g._replace(alpha=np.full(len(g.x), 0.99)),
    "transparent": lambda g: g._replace(alpha=np.zeros(len(g.x))),
    "barely there": lambda g: g._replace(alpha=np.full(len(g.x), 1e-300)),
    "negative scales": lambda g: g._replace(s=g.s * [-1, 1, -1]),
    "flat": lambda g: g._replace(s=g.s * [1, 0, 1]),
    "points": lambda g: g._replace(s=0 * g.s),
    "needles": lambda g: g._replace(s=g.s * [1e-30, -1e-30, 10]),
    "black and white": lambda g: g._replace(color=np.round(g.color)),
    "far": lambda g: g._replace(x=g.x + [0, 0, 1e5]),
    "none": lambda g: Gaussians(*(a[:0] for a in g)),
}


@pytest.mark.parametrize("name", HARD)
@pytest.mark.filterwarnings("error")
def test_hard_cases_give_finite_numbers_and_the_same_picture(name, tmp_path):
    gaussians = HARD[name](some(40))
    write_gaussians(tmp_path / "a.ply", gaussians)
    _, rows = by_hand(tmp_path / "a.ply")
    assert len(rows) == len(gaussians.x) and np.isfinite(rows).all()
    again = read_gaussians(tmp_path / "a.ply")
    assert np.all(again.s > 0) and np.all((again.alpha > 0) & (again.alpha < 1))
    np.testing.assert_allclose(picture(again), picture(gaussians), atol=5e-5)


@pytest.mark.parametrize(
    "field, value",
    [("x", np.nan), ("s", np.inf), ("alpha", np.nan), ("color", 1e39), ("r", np.inf)],
)
@pytest.mark.filterwarnings("error")
def test_what_is_not_finite_is_refused(field, value, tmp_path):
    gaussians = some(4)
    getattr(gaussians, field)[2] = value
    with pytest.raises(SceneError, match="a.ply: 1 Gaussians are NaN or beyond float32"):
        write_gaussians(tmp_path / "a.ply", gaussians)
    assert not list(tmp_path.iterdir())


def test_any_text_can_be_a_comment(tmp_path):
    texts = ["two\nlines\r\nend_header", "Käse \x1b[31m ψ_d", "long " * 99, "element face 3", ""]
    write_gaussians(tmp_path / "a.ply", some(3), texts)
    lines, rows = by_hand(tmp_path / "a.ply")
    assert len(rows) == 3 and len(lines) == 2 + len(texts) + 1 + 17
    assert r"comment two\nlines\r\nend_header" in lines and all(map(str.isprintable, lines))
    np.testing.assert_allclose(read_gaussians(tmp_path / "a.ply").x, some(3).x, atol=1e-6)
