"""Vectors of level L3 for a decoder that draws: pictures of two conformance streams.

Its arrays may all be right, and a network be evaluated wrongly after it was decoded.
"""

import numpy as np

from p4dgs_ref.codec.file import decode
from p4dgs_ref.oracle.compare import cast
from p4dgs_ref.oracle.streams import STREAMS
from p4dgs_ref.splatting.camera import look_at
from tests.workshop.cases import Case
from tests.workshop.flat import CAMERA_SHAPES, described
from tests.workshop.pipeline import drawn_from, frames_vjp
from tests.workshop.subjects import Subject

# Small, not square, and neither centred nor with square pixels.
CAMERA = look_at((1.6, -2.7, 2.1), (0, 0.5, 1), 14.0, 13.0, 16, 12, c_x=7.1, c_y=6.2)


def pictures_vjp(stream, **view):
    """The image of a compressed file: Fig. 1 from end to end, by the `exact` renderer.

    `view` are camera and time: W, T, focal, center, size, t.
    """
    decoded = cast(drawn_from(decode(stream.tobytes())), view["W"].dtype)
    return frames_vjp(**decoded, **view, renderer="exact")


def pictures_cases():
    for name, t, flags in ("full", 0.4, ("ordinary",)), ("static", 0.0, ("off",)):
        stream = (STREAMS / f"{name}.p4dgs").read_bytes()
        inputs = dict(stream=np.frombuffer(stream, np.uint8), **described(CAMERA), t=t)
        yield Case(name, inputs, flags)


SUBJECTS = (
    Subject(
        "pictures",
        "L3",
        "compositing",
        "1 to 6",
        "compressed file -> image",
        {"stream": "B", **CAMERA_SHAPES, "t": "", "image": "H W 3"},
        (),
        pictures_vjp,
        pictures_cases,
        group="pictures",
    ),
)
