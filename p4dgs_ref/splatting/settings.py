"""The renderer's constants (Q21) and three named points between accuracy and time: exact, paper, fast."""

from typing import NamedTuple


class Settings(NamedTuple):
    """What the renderer may leave out, and where the published kernel's constants stand."""

    name: str
    footprint: (
        str  # "all": every Gaussian at every pixel; "ellipse": alpha >= cut; "box": 3-sigma tiles
    )
    dtype: str  # arithmetic of compositing; projection is always float64
    tile: int = 8  # pixels along a tile's side
    cut: float = 0.0  # "ellipse": a Gaussian is listed where its alpha can reach this
    mask: float = 0.0  # per pixel, alpha below this counts as zero
    stop: float = 0.0  # transmittance below this counts as opaque
    stop_by_pixel: bool = (
        False  # stop before the splat that would pass `stop` (kernel), not after a whole tile
    )
    clamp_passes_gradient: bool = (
        False  # the published kernel ignores the alpha clamp in its backward
    )
    near: float = 0.2  # Gaussians at or before this depth are culled
    blur: float = 0.3  # square pixels added to both variances: no splat is narrower than a pixel
    tan_clamp: float = (
        1.3  # times half the image width over f_x: where the Jacobian's x/z is clamped
    )
    alpha_max: float = 0.99  # so that no single splat is opaque


EXACT = Settings("exact", "all", "float64")
PAPER = Settings(
    "paper",
    "box",
    "float32",
    tile=16,
    mask=1 / 255,
    stop=1e-4,
    stop_by_pixel=True,
    clamp_passes_gradient=True,
)
# Half of the 1e-4 that Q21 names: with the tile stop the pixel error then stays below 1e-4, for 5 % more pairs.
FAST = Settings("fast", "ellipse", "float32", cut=5e-5, stop=1e-4)

SETTINGS = {settings.name: settings for settings in (EXACT, PAPER, FAST)}
