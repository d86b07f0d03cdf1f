"""Where the hundredfold comes from: bytes at one PSNR, step by step."""

import imageio.v3 as iio
import pytest

from p4dgs_ref.lab.tables import hundredfold
from p4dgs_ref.lab.tables.methods import ALIKE, AS_STORED, CODED, HALF, OURS

# Times the bytes of the last step, and the share of the network, in the order of the steps.
SIZES = {
    ("d3dgs", AS_STORED): (100, 0.9),
    ("d3dgs_small", AS_STORED): (10, 0.5),
    ("d3dgs_small", HALF): (5, 0.5),
    ("d3dgs_small", ALIKE): (2, 0.25),
    (OURS, ALIKE): (1.5, 0.5),
    (CODED, AS_STORED): (1.25, 0.75),
    ("p4dgs_coded preset=small_coded", AS_STORED): (1, 0.6),
}


def rows(scene, last=36.8):
    """Rows of curves from 33.8 dB on; the last step's ends at `last`."""
    return [
        {
            "method": method.partition(" ")[0],
            "storage": storage,
            "label": f"{method} {storage} {psnr}",
            "iterations": 4,
            "scene": scene,
            "seed": seed,
            "psnr_db": psnr,
            "held_back_db": psnr,
            "bytes": size * (1 + 0.1 * seed),
            "network_bytes": share * size * (1 + 0.1 * seed),
            "gaussians_bytes": (1 - share) * size * (1 + 0.1 * seed),
        }
        for (method, storage), (times, share) in SIZES.items()
        for psnr, size in ((33.8, 1000 * times), (last, 8000 * times))
        for seed in (0, 1)
    ]


def test_every_step_is_compared_with_the_one_before_it_at_one_psnr():
    figure, others = (
        [row for row in hundredfold.steps(rows("figure") + rows("other")) if row["scene"] == scene]
        for scene in ("figure", "glossy")
    )
    assert not others and [row["step"] for row in figure] == [*hundredfold.STEPS]
    # A third of the way from 33.8 to 36.8 dB in the logarithm, and the mean of both seeds.
    assert figure[-1]["bytes"] == pytest.approx(2000 * 1.05)
    assert [row["factor"] for row in figure[1:]] == pytest.approx([10, 2, 2.5, 4 / 3, 1.2, 1.25])
    assert "factor" not in figure[0]
    for row, (_, share) in zip(figure, SIZES.values()):
        assert row["network_bytes"] == pytest.approx(share * row["bytes"])
        assert row["gaussians_bytes"] == pytest.approx((1 - share) * row["bytes"])
        assert row["bytes_spread"] == pytest.approx(row["bytes"] / 1.05 * 0.05)


def test_a_step_that_does_not_reach_the_psnr_has_no_bytes(tmp_path):
    found = hundredfold.steps(rows("glossy", last=35.5))
    assert all("bytes" not in row and "factor" not in row for row in found)
    hundredfold.draw_steps(tmp_path / "some.png", found + hundredfold.steps(rows("figure")))
    assert iio.imread(tmp_path / "some.png").std() > 5
    lines = hundredfold.to_lines(found)
    assert len(lines) == 3 + len(hundredfold.STEPS) and lines[2].endswith("-")
    assert hundredfold.to_lines([]) == []
