"""From 3D Gaussians to an image and back: covariance, projection and compositing in a row."""

import numpy as np

from . import compositing, covariance, fast, projection


def forward(
    x,  # [N, 3]  centres (scene units)
    s,  # [N, 3]  standard deviations (scene units)
    r,  # [N, 4]  unit quaternions (w, x, y, z)
    alpha,  # [N]  opacities
    color,  # [N, 3]  colours in [0, 1]
    camera,  # a Camera
    background,  # [3]  colour behind everything
    settings,  # a Settings; its footprint "all" takes `compositing`, every other one `fast` (Q21)
    occlusion=True,
    keep=True,  # False: no gradients are wanted; then nothing is kept for `backward`
):
    """Return the image [H, W, 3], the transmittance [H, W], visible [N] and what `backward` needs.

    Projection is computed in float64 and in the frame of each Gaussian's axes, where Sigma is
    diag(s)^2, so that needles of any length keep their digits; compositing in `settings.dtype`.
    Raises ValueError for an opacity that is negative or NaN: lists of tiles would leave it out, the
    exact twin would not.
    """
    (Sigma, R), saved_axes = covariance.axes(s.astype(float), r.astype(float))
    out, saved = from_covariances(
        x, Sigma, alpha, color, camera, background, settings, occlusion, keep, R
    )
    return out, (saved_axes, *saved)


def backward(saved, image_bar):
    """Gradients of x, s, r, alpha, color and background, and of mean2d for density control."""
    saved_axes, *saved = saved
    bars = from_covariances_backward(saved, image_bar)
    return {**covariance.axes_backward(saved_axes, bars.pop("Sigma"), bars.pop("R")), **bars}


def from_covariances(
    x,  # [N, 3]
    Sigma,  # [N, 3, 3]  covariances, symmetric (square scene units)
    alpha,  # [N]
    color,  # [N, 3]
    camera,
    background,  # [3]
    settings,
    occlusion=True,
    keep=True,
    R=None,  # [N, 3, 3]  with a diagonal Sigma: the covariances are R Sigma R^T
):
    """What `forward` returns, for Gaussians with any covariances."""
    splats, saved_projection = project(x, Sigma, camera, settings, R)
    mean2d, cov2d, conic, depth, visible = splats
    alpha, color, background = (np.asarray(a, float) for a in (alpha, color, background))
    bad = np.flatnonzero(~(alpha >= 0))
    if len(bad):
        raise ValueError(f"alpha[{bad[0]}] is {alpha[bad[0]]}: expected at least 0")
    looks = (alpha, color, depth, visible, background, camera.height, camera.width)
    if settings.footprint == "all":
        compositor = compositing
        out, saved = compositing.forward(mean2d, conic, *looks, occlusion, settings.alpha_max)
    else:
        compositor = fast
        out, saved = fast.forward(mean2d, cov2d, conic, *looks, settings, occlusion, keep)
    return (*out, visible), (saved_projection, compositor, saved)


def from_covariances_backward(saved, image_bar):
    """Gradients of x, Sigma, R if there was one, alpha, color, background, and of mean2d."""
    saved_projection, compositor, saved_compositing = saved
    splats = compositor.backward(saved_compositing, image_bar)
    mean2d_bar, conic_bar = splats["mean2d"], splats.pop("conic")
    places = projection.backward(saved_projection, mean2d_bar=mean2d_bar, conic_bar=conic_bar)
    return {**places, **splats}


def project(x, Sigma, camera, settings, R=None):
    """Return the output of `projection` for a camera, and what it saved."""
    return projection.forward(
        x.astype(float),
        Sigma.astype(float, copy=False),
        camera.R,
        camera.T,
        np.array([camera.f_x, camera.f_y]),
        np.array([camera.c_x, camera.c_y]),
        np.array([camera.width, camera.height]),
        settings.near,
        settings.blur,
        settings.tan_clamp,
        R,
    )
