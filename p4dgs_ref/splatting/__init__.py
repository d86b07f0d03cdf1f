"""What the paper takes from 3D Gaussian splatting: camera, covariance, projection, compositing."""
from . import compositing, covariance, projection  # noqa: F401  declared in this order, after the paper's equations
