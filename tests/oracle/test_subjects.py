"""Scalars, stages and the pipeline as subjects of vectors.

What holds for the gradients of every equation (`tests/equations`) holds for what is published of
these subjects, because `test_published.py` compares their code with it.
"""

import numpy as np

from p4dgs_ref.splatting.settings import EXACT
from tests.workshop import pipeline
from tests.workshop.flat import camera_of
from tests.workshop.subjects import subjects


def test_frames_are_those_of_the_decoded_model():
    golden, frames = pipeline.golden_model(), subjects()["frames"]
    exact = [case for case in frames.cases() if case.inputs["renderer"] == "exact"]
    moments = {(case.inputs["t"], case.inputs["focal"][0]) for case in exact}
    assert len(exact) == len(moments) == 6 and len({t for t, _ in moments}) == 3
    for case in exact:
        camera = camera_of(*(case.inputs[name] for name in ("W", "T", "focal", "center", "size")))
        assert camera.f_x != camera.f_y and camera.width != camera.height
        assert abs(camera.c_x - (camera.width - 1) / 2) > 0.5
        assert abs(camera.c_y - (camera.height - 1) / 2) > 0.5
        image = golden.render(camera, case.inputs["t"], EXACT)
        assert np.array_equal(frames(**case.inputs)["image"], image)
