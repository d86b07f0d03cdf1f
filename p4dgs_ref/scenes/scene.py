"""A scene: views with cameras and times, the effects that happen in it, and a background.

Everything is checked when a scene is made, so that training and evaluation can rely on it.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..splatting.camera import Camera
from .fields import (
    MAX_COORDINATE,
    MAX_LENS,
    MIN_LENS,
    REQUIRED,
    choice,
    fields,
    list_of,
    numbers,
    require_field,
)

# The closed lists of effects. The simulator knows the effects of the model and three of its own.
MODEL_EFFECTS = (
    "translation",
    "rotation",
    "scaling",
    "view_color",
    "view_geometry",
    "occlusion",
    "background",
)
SIMULATOR_EFFECTS = (*MODEL_EFFECTS, "texture", "diffuse", "specular")

WHITE = (1.0, 1.0, 1.0)
# Files print six or seven digits. A scaled or mirrored matrix is further from a rotation than this.
ROTATION_TOLERANCE = 1e-3


def rotation(value, where):
    """Check that a 3 x 3 matrix is a rotation: orthonormal, and not a reflection."""
    R = numbers(value, where, -MAX_COORDINATE, MAX_COORDINATE, (3, 3))
    error, determinant = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.det(R)
    require_field(
        error <= ROTATION_TOLERANCE and determinant > 0,
        where,
        f"off orthonormal by {error:.2g}, determinant {determinant:.2g}; expected a rotation "
        f"(to {ROTATION_TOLERANCE:g}) with determinant +1",
    )
    return R


# Checks that several formats share, and the fields of a camera.
SHARE = partial(numbers, low=0, high=1)
COLOR = partial(SHARE, shape=(3,))
NUMBER = partial(numbers, low=-MAX_COORDINATE, high=MAX_COORDINATE)
POINT = partial(NUMBER, shape=(3,))
FOCAL = partial(numbers, low=MIN_LENS, high=MAX_LENS)
PRINCIPAL = partial(numbers, low=-MAX_LENS, high=MAX_LENS)
CAMERA = {
    "R": (rotation, REQUIRED),
    "T": (POINT, REQUIRED),
    **dict.fromkeys(("f_x", "f_y"), (FOCAL, REQUIRED)),
    **dict.fromkeys(("c_x", "c_y"), (PRINCIPAL, REQUIRED)),
}


@dataclass(frozen=True, eq=False)
class View:
    """One picture of the scene."""

    name: str
    image: np.ndarray  # [H, W, 3] float32 in [0, 1], over the background of the scene
    alpha: np.ndarray | None  # [H, W] float32 in [0, 1]; None if the files have no alpha
    camera: Camera
    time: float  # in [0, 1]


@dataclass(frozen=True, eq=False)
class Scene:
    """Views to train on and views to evaluate on, all of one size.

    A scene needs at least one training view; `test` may be empty. `effects` may be any
    list of names; the scene keeps those of MODEL_EFFECTS, in that order. Without the effect
    `background` the background is black. Raises SceneError, which names what cannot be used.
    """

    name: str
    train: Sequence[View]  # made a tuple, like `test`
    test: Sequence[View] = ()
    effects: tuple[str, ...] = MODEL_EFFECTS
    background: ArrayLike = WHITE  # [3], made float32
    source: Path | None = None  # the folder it was read from
    points: np.ndarray | None = None  # [A, 3]  where anchors start; None: at random positions

    def __post_init__(self):
        where = self.source or self.name
        effects = model_effects(self.effects, f"{where}: effects")
        checked = {
            # bytes in the name of a folder that are not UTF-8 are shown as escapes
            "name": str(self.name).encode(errors="backslashreplace").decode(),
            "train": tuple(self.train),
            "test": tuple(self.test),
            "effects": effects,
            "background": background_color(self.background, effects, where),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)  # the class is frozen for its users
        require_field(self.train, f"{where}: train", "no views; expected at least one")
        for view in self.train + self.test:
            check_view(view, self.train[0], f"{where}: {view.name}")

    @property
    def center(self):
        """Return the point [3] nearest to the axes of the training cameras, by least squares.

        Of several such points, as for nearly parallel axes, it is the one nearest to the origin.
        """
        cameras = [view.camera for view in self.train]
        across = [np.eye(3) - np.outer(c.R[2], c.R[2]) for c in cameras]  # an axis is R[2]
        total = sum(A @ c.center for A, c in zip(across, cameras))
        return np.linalg.lstsq(sum(across), total, rcond=1e-3)[0]

    @classmethod
    def from_arrays(
        cls,
        images: Iterable[ArrayLike],
        cameras: Iterable[Camera],
        times: Iterable[float],
        *,
        test: Iterable[int] = (),
        effects: Collection[str] | None = None,
        background: ArrayLike = WHITE,
        name: str = "arrays",
    ) -> "Scene":
        """Make a scene from n images, cameras and times in [0, 1] instead of files.

        An image is [H, W, 3] or [H, W, 4], unsigned integers or floats in [0, 1]. RGBA is straight
        (not premultiplied) and is laid over the background. `test` lists the indices of views that
        are not trained on. Without `effects` the scene has all of the model's.
        """
        images, cameras, times = list(images), list(cameras), list(times)
        require_field(
            len(images) == len(cameras) == len(times),
            f"{name}: images, cameras, times",
            f"{len(images)}, {len(cameras)} and {len(times)}; expected equal numbers",
        )
        held_back = list_of(
            list(test),
            f"{name}: test",
            partial(numbers, low=0, high=len(images) - 1, kind=int),
        )
        listed = model_effects(effects, f"{name}: effects")
        color = background_color(background, listed, name)
        views = [
            View(
                f"images[{i}]",
                *over_background(as_float(image, f"{name}: images[{i}]"), color),
                camera,
                time,
            )
            for i, (image, camera, time) in enumerate(zip(images, cameras, times))
        ]
        train = [view for i, view in enumerate(views) if i not in held_back]
        return cls(name, train, [views[i] for i in sorted({*held_back})], listed, color)


def check_effects(names, where, known=SIMULATOR_EFFECTS):
    """Return the `known` effects of a list, in that order; None stands for the model's."""
    listed = list_of(
        MODEL_EFFECTS if names is None else names,
        where,
        partial(choice, words=SIMULATOR_EFFECTS),
        unique=True,
    )
    return tuple(effect for effect in known if effect in listed)


model_effects = partial(check_effects, known=MODEL_EFFECTS)


def background_color(background, effects, where):
    """Return the background as float32; black if the scene does not list the effect."""
    color = COLOR(background, f"{where}: background")
    return color.astype(np.float32) if "background" in effects else np.zeros(3, np.float32)


def size_of(image):
    """Return the width and height of an image in words."""
    return f"{image.shape[1]}x{image.shape[0]}"


def as_float(image, where):
    """Return the pixels as float32, unsigned integers divided by their largest value."""
    image = np.asarray(image)
    require_field(
        image.ndim == 3 and image.shape[2] in (3, 4) and image.size and image.dtype.kind in "uf",
        where,
        f"{image.dtype} of shape {image.shape}; expected (H, W, 3) or (H, W, 4), uint8 or floats "
        "in [0, 1]",
    )
    largest = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1
    return image.astype(np.float32) / np.float32(largest)


def over_background(image, color):
    """Return the RGB picture of an RGBA picture over a colour, and its alpha (None for RGB)."""
    if image.shape[2] == 3:
        return image, None
    alpha = np.ascontiguousarray(image[..., 3])
    return image[..., :3] * alpha[..., None] + color * (1 - alpha[..., None]), alpha


def check_view(view, first, where):
    """Refuse a view that is inconsistent, out of range or not of the first view's size."""
    image, camera = view.image, view.camera
    require_field(
        image.shape == first.image.shape == (camera.height, camera.width, 3),
        where,
        f"{size_of(image)} pixels, camera of {camera.width}x{camera.height}; expected RGB and "
        f"{size_of(first.image)}, the same for all views",
    )
    for name, values in (("image", image), ("alpha", view.alpha)):
        require_field(
            values is None or (values.min() >= 0 and values.max() <= 1 + 1e-6),
            f"{where}: {name}",
            "values outside [0, 1], or not finite; expected finite values in [0, 1]",
        )
    fields(vars(camera), f"{where}: camera", CAMERA, others=True)
    SHARE(view.time, f"{where}: time")
