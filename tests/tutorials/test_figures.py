"""The figures of the tutorials, and the anchor that they follow."""

import numpy as np
import pytest

from p4dgs_ref import decode
from p4dgs_ref.scenes import load, simulator
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import FAST
from tests import ROOT
from tutorials.tools import figures


def test_every_line_with_a_label_has_it_at_its_place_and_in_its_colour():
    _, ax = figures.pyplot().subplots()
    ax.plot([0, 1], color="r", label="up")
    ax.plot([1, 0])
    figures.label(ax, (0.5, 0.2))
    (text,) = ax.texts
    assert (text.get_text(), text.get_position(), text.get_color()) == ("up", (0.5, 0.2), "r")
    with pytest.raises(ValueError, match="zip"):
        figures.label(ax)


def test_the_thread_anchor_is_seen_changes_its_colour_moves_and_has_a_masked_child():
    thread = figures.THREAD
    model = decode((ROOT / "tutorials" / "demo.p4dgs").read_bytes())
    scene = simulator.read_description(load.find_scene("bouncing") / load.DESCRIPTION)
    cameras = [
        simulator.camera_at(scene, azimuth, np.radians(26))
        for azimuth in np.radians(range(0, 360, 15))
    ]
    mask, first = model.anchors.mask[thread.index], model.design.k * thread.index
    assert thread.name == f"anchor {thread.index}" and list(mask) == [False, True, True, True]
    children = first + np.flatnonzero(mask)
    colors = []
    for camera in cameras:
        *inputs, index = model.gaussians(0.3, camera)
        (image, *_), saved = render.forward(*inputs, camera, model.background, FAST)
        mine = np.flatnonzero(np.isin(index, children))
        assert (index[mine] == children).all()
        shares = render.backward(saved, np.ones_like(image))["color"]  # in pixels, a channel each
        assert shares[mine].sum() / 3 > 2  # never hidden
        colors.append(inputs[4][index == first + thread.child][0])
    assert 255 * np.ptp(colors, axis=0).max() > 60
    places = [model.gaussians(t, cameras[0])[0][mine] for t in np.linspace(0, 1, 11)]
    assert (np.ptp(places, axis=0)[:, 2] > 0.3).all()
