"""What the paper takes from 3D Gaussian splatting: camera, covariance, projection, compositing."""

from . import covariance, projection, compositing  # noqa: F401, I001  declared in this order, that of the data
