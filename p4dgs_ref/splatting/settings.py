"""The renderer's constants, and three named settings of accuracy and time: exact, kernel, fast."""

from typing import NamedTuple


class Settings(NamedTuple):
    """What the renderer may leave out, and the constants of the published kernel."""

    name: str
    # Where a Gaussian is evaluated: "all" pixels, the "ellipse" where alpha >= cut, or the "box"
    # of the kernel, the tiles that meet a square of 3 sigma.
    footprint: str
    dtype: str  # precision of compositing; projection is always float64
    tile: int = 8  # pixels along a tile's side
    cut: float = 0.0  # smallest alpha for which a Gaussian is listed, for the footprint "ellipse"
    mask: float = 0.0  # a smaller alpha counts as zero, pixel by pixel
    stop: float = 0.0  # a smaller transmittance counts as opaque
    # The kernel stops before the splat that would pass `stop`, pixel by pixel; otherwise a tile
    # stops between two chunks of its list.
    stop_by_pixel: bool = False
    clamp_passes_gradient: bool = False  # the kernel's backward ignores the clamp of alpha
    near: float = 0.2  # Gaussians at this depth or nearer are culled
    # Added to both variances, in square pixels, so that no splat is much narrower than a pixel.
    blur: float = 0.3
    tan_clamp: float = 1.3  # clamp of x/z in the Jacobian, times half the image's width over f_x
    alpha_max: float = 0.99  # so that no single splat is opaque


EXACT = Settings("exact", "all", "float64")
KERNEL = Settings(
    "kernel",
    "box",
    "float32",
    tile=16,
    mask=1 / 255,
    stop=1e-4,
    stop_by_pixel=True,
    clamp_passes_gradient=True,
)
# With colours from 0 to 1, the error of a pixel is at most the sum of the alphas below the cut,
# plus the transmittance at which its tile stops. The error grows with the number of Gaussians that
# are left out, and reaches 1.84e-4 in a test view of tutorials/demo.p4dgs. A cut of 5e-5 has 4 %
# more pairs than one of 1e-4.
FAST = Settings("fast", "ellipse", "float32", cut=5e-5, stop=1e-4)

SETTINGS = {settings.name: settings for settings in (EXACT, KERNEL, FAST)}
