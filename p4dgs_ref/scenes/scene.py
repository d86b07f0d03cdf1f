"""A scene: posed and timed views, the effects that happen in them, the background; all checked when it is made."""

import math
from dataclasses import dataclass

import numpy as np

from ..splatting.camera import Camera

# The closed lists (README, "Effects").  The simulator knows the model's effects and three of its own.
MODEL_EFFECTS = (
    "translation",
    "rotation",
    "scaling",
    "view_color",
    "view_geometry",
    "occlusion",
    "background",
)
SIMULATOR_EFFECTS = MODEL_EFFECTS + ("texture", "diffuse", "specular")

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
ROTATION_TOLERANCE = (
    1e-3  # files print six or seven digits; a scaled or mirrored matrix is off by far more
)


class SceneError(ValueError):
    """A mistake in a scene: one line that names the file, the field and what was expected."""

    def __init__(self, where, expected):
        super().__init__(" ".join(f"{where}: {expected}".split()))


@dataclass(frozen=True, eq=False)
class View:
    """One picture of the scene.

    Shapes     image (H, W, 3) float32 over the scene's background; alpha (H, W) float32, None where files have none
    Units      image and alpha in [0, 1]; time in [0, 1]
    """

    name: str
    image: np.ndarray
    alpha: np.ndarray | None
    camera: Camera
    time: float


@dataclass(frozen=True, eq=False)
class Scene:
    """Views to learn from and views to be judged by.

    Shapes     train, test, val: tuples of View of one size; background (3,) float32
    Units      effects: those of MODEL_EFFECTS that happen here, in that order
    Domain     at least one training view; test and val may be empty
    Raises     SceneError for views, effects or a background that cannot be used
    Choice     Q20: cameras; a scene that does not list `background` stands before black, the neutral input
    """

    name: str
    train: tuple
    test: tuple = ()
    val: tuple = ()
    effects: tuple = MODEL_EFFECTS
    background: np.ndarray = BACKGROUNDS["white"]
    source: object = None

    def __post_init__(self):
        for split in ("train", "test", "val"):
            object.__setattr__(self, split, tuple(getattr(self, split)))
        object.__setattr__(self, "effects", model_effects(self.effects, f"{self.name}: effects"))
        object.__setattr__(
            self, "background", background_color(self.background, self.effects, self.name)
        )
        if not self.train:
            raise SceneError(f"{self.name}: train", "no views; expected at least one")
        size = self.train[0].image.shape
        for view in self.train + self.test + self.val:
            check_view(view, size, f"{self.name}: {view.name}")

    @classmethod
    def from_arrays(
        cls, images, cameras, times, *, test=(), effects=None, background="white", name="arrays"
    ):
        """A scene without files.

        Shapes     images n of (H, W, 3) or (H, W, 4); cameras n of Camera; times n; test: indices of held-out views
        Units      images: uint8, or floats in [0, 1]; RGBA is straight (not premultiplied) and is laid over the
                   background; RGB is taken as it is; times in [0, 1]
        Raises     SceneError
        """
        images, cameras, times, test = list(images), list(cameras), list(times), list(test)
        if not len(images) == len(cameras) == len(times):
            raise SceneError(
                f"{name}: images, cameras, times",
                f"{len(images)}, {len(cameras)} and {len(times)}; expected equal numbers",
            )
        for position, i in enumerate(test):
            if not isinstance(i, (int, np.integer)) or not 0 <= i < len(images):
                raise SceneError(
                    f"{name}: test[{position}]", f"{i!r}; expected an index in 0..{len(images) - 1}"
                )
        effects = model_effects(effects, f"{name}: effects")
        color = background_color(background, effects, name)
        views = []
        for i, (image, camera, time) in enumerate(zip(images, cameras, times)):
            pixels, alpha = over_background(as_float(image, f"{name}: images[{i}]"), color)
            views.append(
                View(f"images[{i}]", pixels, alpha, camera, check_time(time, f"{name}: times[{i}]"))
            )
        held_out = {int(i) for i in test}
        return cls(
            name,
            [v for i, v in enumerate(views) if i not in held_out],
            [views[i] for i in sorted(held_out)],
            effects=effects,
            background=color,
        )


def check_effects(names, where):
    """The list as it stands in a file, every name known to the simulator; None stands for all of the model's."""
    if names is None:
        return MODEL_EFFECTS
    if isinstance(names, str) or not isinstance(names, (list, tuple, set, frozenset)):
        raise SceneError(where, f"{names!r}; expected a list of names")
    for name in names:
        if name not in SIMULATOR_EFFECTS:
            raise SceneError(
                where, f"unknown effect {name!r}; expected some of {', '.join(SIMULATOR_EFFECTS)}"
            )
    return tuple(effect for effect in SIMULATOR_EFFECTS if effect in names)


def model_effects(names, where):
    """The model's part of a list of effects, in the order of MODEL_EFFECTS."""
    return tuple(effect for effect in check_effects(names, where) if effect in MODEL_EFFECTS)


def background_color(background, effects, where):
    """Three float32 in [0, 1] from a name or numbers; black where the scene lists no background."""
    if isinstance(background, str) and background not in BACKGROUNDS:
        raise SceneError(
            f"{where}: background",
            f"{background!r}; expected white, black or three numbers in [0, 1]",
        )
    color = as_array(BACKGROUNDS[background] if isinstance(background, str) else background)
    if color is None or color.shape != (3,) or not (np.all(color >= 0) and np.all(color <= 1)):
        raise SceneError(
            f"{where}: background",
            f"{background!r}; expected white, black or three numbers in [0, 1]",
        )
    return color.astype(np.float32) if "background" in effects else np.zeros(3, np.float32)


def as_array(values):
    """Finite or infinite numbers as float64, None for anything else (ragged lists, text, nothing)."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None


def as_float(image, where):
    """Pixels as float32 in [0, 1], from integers of any width or from floats."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
        raise SceneError(where, f"an array of shape {image.shape}; expected (H, W, 3) or (H, W, 4)")
    if image.dtype.kind == "u":
        return image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
    if image.dtype.kind != "f":
        raise SceneError(where, f"pixels of type {image.dtype}; expected uint8 or floats in [0, 1]")
    return image.astype(np.float32)


def over_background(image, color):
    """RGB and alpha of an RGBA picture laid over a colour; an RGB picture is left alone and has no alpha."""
    if image.shape[2] == 3:
        return image, None
    alpha = image[..., 3]
    return image[..., :3] * alpha[..., None] + color * (1 - alpha[..., None]), np.ascontiguousarray(
        alpha
    )


def check_time(time, where):
    """A time as a Python float in [0, 1]."""
    number = isinstance(time, (int, float, np.integer, np.floating)) and not isinstance(time, bool)
    if not number or not 0 <= time <= 1:
        raise SceneError(where, f"{time!r}; expected a number in [0, 1]")
    return float(time)


def check_rotation(R, where):
    """A 3 by 3 rotation: orthonormal within the tolerance, determinant +1."""
    if not np.all(np.isfinite(R)):
        raise SceneError(where, "not finite; expected finite numbers")
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > ROTATION_TOLERANCE:
        raise SceneError(
            where,
            f"off orthonormal by {error:.2g}; expected a rotation (to {ROTATION_TOLERANCE:g})",
        )
    if np.linalg.det(R) < 0:
        raise SceneError(where, "determinant -1, a mirror; expected a rotation, determinant +1")


def check_view(view, size, where):
    """One view against its camera, its range and the size that all views share."""
    camera = view.camera
    if view.image.shape != size or view.image.ndim != 3 or size[2] != 3:
        raise SceneError(
            where, f"image of shape {view.image.shape}; expected {size}, the same for all views"
        )
    if (camera.height, camera.width) != size[:2]:
        raise SceneError(
            f"{where}: camera",
            f"{camera.width}x{camera.height} pixels; expected {size[1]}x{size[0]}",
        )
    for name, values in (("image", view.image), ("alpha", view.alpha)):
        if values is not None and not (
            values.min() >= 0 and values.max() <= 1 + 1e-6
        ):  # also false for NaN
            raise SceneError(
                f"{where}: {name}",
                "values beyond [0, 1] or not finite; expected finite ones in [0, 1]",
            )
    if view.alpha is not None and view.alpha.shape != size[:2]:
        raise SceneError(f"{where}: alpha", f"shape {view.alpha.shape}; expected {size[:2]}")
    if np.shape(camera.R) != (3, 3) or np.shape(camera.T) != (3,):
        raise SceneError(
            f"{where}: camera",
            f"R {np.shape(camera.R)}, T {np.shape(camera.T)}; expected (3, 3), (3,)",
        )
    check_rotation(camera.R, f"{where}: camera.R")
    if not np.all(np.isfinite(camera.T)):
        raise SceneError(f"{where}: camera.T", "not finite; expected finite numbers")
    if not (0 < camera.f_x < math.inf and 0 < camera.f_y < math.inf):
        raise SceneError(
            f"{where}: camera",
            f"focal lengths {camera.f_x}, {camera.f_y}; expected positive numbers",
        )
    if not (math.isfinite(camera.c_x) and math.isfinite(camera.c_y)):
        raise SceneError(
            f"{where}: camera",
            f"principal point {camera.c_x}, {camera.c_y}; expected finite numbers",
        )
    check_time(view.time, f"{where}: time")
