"""The part of the format page that leads from a decoded file to a picture."""

import re

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref.codec.__main__ import PICTURE, page
from p4dgs_ref.equations import view
from p4dgs_ref.oracle.streams import STREAMS
from p4dgs_ref.splatting import covariance, projection

PLACE = (40.0, 40.0), (15.5, 11.5), (32, 24)  # focal lengths, principal point, size
W, X_C = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([-1.5, -8, 3.5])


def test_the_worked_numbers_are_those_of_the_package():
    text = PICTURE.read_text(encoding="utf-8")
    assert text.strip() in page() and len(text.splitlines()) <= 80
    pairs = re.findall(r"^    (\w+) = \(?([-\d., ]+)\)?$", text, re.M)
    said = {name: np.array(numbers.split(","), float) for name, numbers in pairs}
    model = p4.decode((STREAMS / "one_anchor.p4dgs").read_bytes())
    camera = p4.Camera(W, -W @ X_C, 40.0, 40.0, 15.5, 11.5, 32, 24)
    first, *_ = p4.model.predict(model.design, model.networks, model.anchors, X_C)
    g, (seen, _) = model.gaussians(0.5, camera), view.forward(model.anchors.x_a, X_C)
    Sigma, place = covariance.forward(g.s, g.r)[0], [np.array(a) for a in PLACE]
    (mean, abc, _, z, _), _ = projection.forward(g.x, Sigma, W, camera.T, *place)
    made = dict(delta_vc=seen[0], d_vc=seen[1], alpha=g.alpha, color=g.color, x=first.x)
    made |= dict(s=first.s, r=first.r, x_t=g.x, s_t=g.s, r_t=g.r, z=z, mean=mean, abc=abc)
    for name, numbers in said.items():
        np.testing.assert_allclose(numbers, made.pop(name).ravel(), atol=1e-10, err_msg=name)
    color = model.render(camera, 0.5, p4.SETTINGS["exact"])[20, 31]
    assert "(" + ", ".join(f"{c:.10f}" for c in color) + ")" in text and not made
