"""From 3D Gaussians to an image and back: covariance and projection, then compositing."""

import numpy as np

from . import compositing, factored, fast


def forward(
    x,  # [N, 3]  centres (scene units)
    s,  # [N, 3]  standard deviations (scene units)
    r,  # [N, 4]  unit quaternions (w, x, y, z)
    alpha,  # [N]  opacities
    color,  # [N, 3]  colours in [0, 1]
    camera,  # a Camera
    background,  # [3]  colour behind everything
    settings,  # a Settings; footprint "all" uses `compositing`, every other one `fast` (Q21)
    occlusion=True,
    keep=True,  # False: no gradients are wanted; then nothing is kept for `backward`
):
    """Return the image [H, W, 3], the transmittance [H, W], visible [N] and what `backward` needs.

    Projection is computed in float64 by `factored`, compositing in `settings.dtype`. Raises
    ValueError for an opacity that is negative or NaN: the lists by tile would leave it out, but the
    exact twin would not.
    """
    splats, saved_projection = project(x, s, r, camera, settings)
    out, saved = composite(splats, alpha, color, camera, background, settings, occlusion, keep)
    return out, (saved_projection, saved)


def backward(saved, image_bar):
    """Return the gradients of x, s, r, alpha, color, background, and mean2d for density control."""
    saved_projection, (compositor, saved_splats) = saved
    bars = compositor.backward(saved_splats, image_bar)
    return {**factored.backward(saved_projection, bars["mean2d"], bars.pop("conic")), **bars}


def project(x, s, r, camera, settings):
    """Return the splats of a camera, in float64, and what `factored.backward` needs."""
    x, s, r = (a.astype(float) for a in (x, s, r))
    return factored.forward(x, s, r, **pinhole(camera, settings))


def pinhole(camera, settings) -> dict:
    """Return a camera and the constants of projection, as arguments of `projection`."""
    return dict(
        W=camera.R,
        T=camera.T,
        focal=np.array([camera.f_x, camera.f_y]),
        center=np.array([camera.c_x, camera.c_y]),
        size=np.array([camera.width, camera.height]),
        near=settings.near,
        blur=settings.blur,
        tan_clamp=settings.tan_clamp,
    )


def composite(splats, alpha, color, camera, background, settings, occlusion, keep):
    """Composite in float64; return what `forward` returns, the compositor and what it saved."""
    mean2d, cov2d, conic, depth, visible = splats
    alpha, color, background = (np.asarray(a, float) for a in (alpha, color, background))
    bad = np.flatnonzero(~(alpha >= 0))
    if len(bad):
        raise ValueError(f"alpha[{bad[0]}] is {alpha[bad[0]]}: expected at least 0")
    others = (alpha, color, depth, visible, background, camera.height, camera.width)
    if settings.footprint == "all":
        compositor = compositing
        out, saved = compositing.forward(mean2d, conic, *others, occlusion, settings.alpha_max)
    else:
        compositor = fast
        out, saved = fast.forward(mean2d, cov2d, conic, *others, settings, occlusion, keep)
    return (*out, visible), (compositor, saved)
