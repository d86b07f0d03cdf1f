"""The pinhole camera (Q20): OpenCV axes, x right, y down, z forward; pixel centres at integer coordinates."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """x_cam = R @ x_world + T;  u = f_x X/Z + c_x,  v = f_y Y/Z + c_y in pixels.

    Shapes     R (3, 3) world to camera, T (3,); the rest are scalars
    Units      T: scene units; f_x, f_y, c_x, c_y: pixels, (c_x, c_y) = ((W-1)/2, (H-1)/2) at the image centre
    Raises     nothing; files are validated where they are loaded
    """

    R: np.ndarray
    T: np.ndarray
    f_x: float
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
    """A camera at `position` that looks at `target`; z is up in the world unless `up` says otherwise."""
    forward = np.subtract(target, position).astype(float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])  # y points down: forward x right
    c_x, c_y = (width - 1) / 2 if c_x is None else c_x, (height - 1) / 2 if c_y is None else c_y
    return Camera(
        R,
        -R @ np.asarray(position, float),
        float(f_x),
        float(f_y),
        float(c_x),
        float(c_y),
        width,
        height,
    )
