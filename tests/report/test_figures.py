"""The promised quality of decoded files on the tiny scenes, at the default settings.

The file of `bouncing` is judged by the demo's figures, in `test_readme.py`.
"""

import pytest

import p4dgs_ref as p4
from p4dgs_ref.report.inspect import components


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, psnr_db, ssim, most_bytes",
    [
        ("figure", 30.5, 0.978, 50_000),
        ("glossy", 32.0, 0.978, 50_000),
        ("static", 33.0, 0.978, 30_000),
    ],
)
def test_tiny_preset_reaches_its_quality(name, psnr_db, ssim, most_bytes):
    scene = p4.load_scene(name)
    data = p4.encode(p4.train(scene, "tiny", seed=0))
    metrics, rows, _ = p4.evaluate(p4.decode(data), scene)
    print(f"{name}: {metrics['psnr_db']:.2f} dB, SSIM {metrics['ssim']:.4f}, {len(data)} bytes")
    assert (
        metrics["psnr_db"] >= psnr_db
        and metrics["ssim"] >= ssim
        and len(data) <= most_bytes
        and len(rows) == 10
    )
    assert ("deformation_mlp" in components(data)) == (name != "static")


@pytest.mark.slow
def test_a_smooth_orbit_confounds_time_with_view():
    """`orbit` differs from `bouncing` in the training cameras only, and is clearly worse."""
    scores = {}
    for name in ("orbit", "bouncing"):
        scene = p4.load_scene(name)
        model = p4.train(scene, "tiny", seed=0, stage_ends=(200, 300, 1200, 1800), decay_from=1200)
        scores[name] = p4.evaluate(model, scene)[0]["psnr_db"]
    print(scores)
    assert scores["orbit"] < scores["bouncing"] - 1.5
