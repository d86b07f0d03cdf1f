"""The pinhole camera: x right, y down, z forward, pixel centres at integer coordinates (Q20)."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A camera: x_cam = R @ x_world + T = (X, Y, Z), u = f_x X/Z + c_x, v = f_y Y/Z + c_y.

    The image's centre is at u = (width - 1) / 2, v = (height - 1) / 2. Nothing is checked here; a
    scene checks its cameras.
    """

    R: np.ndarray  # [3, 3] world to camera
    T: np.ndarray  # [3]    scene units
    f_x: float  # focal lengths and principal point in pixels
    f_y: float
    c_x: float
    c_y: float
    width: int
    height: int

    @property
    def center(self):
        """The camera's position in the world, x_c of Eq. (2)."""
        return -self.R.T @ self.T


def look_at(position, target, f_x, f_y, width, height, c_x=None, c_y=None, up=(0.0, 0.0, 1.0)):
    """Return a camera at `position` that looks at `target`; `up` is drawn upwards in the image.

    Without c_x or c_y the principal point is the image's centre. Raises ValueError if the target
    is the position, or if `up` is the direction of the view or its opposite.
    """
    forward = np.subtract(target, position).astype(float)
    if not np.cross(forward, up).any():
        raise ValueError("look_at: expected position, target and position + up not on one line")
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])  # y points down: forward x right
    T = -R @ np.asarray(position, float)
    c_x = (width - 1) / 2 if c_x is None else c_x
    c_y = (height - 1) / 2 if c_y is None else c_y
    return Camera(R, T, float(f_x), float(f_y), float(c_x), float(c_y), width, height)
