"""Heat maps of errors over two logarithmic axes, in the stability map and the likelihood study."""

import numpy as np

from ..report import pyplot


def draw_heatmap(ax, x, y, log, limits):
    """Draw log10 of an error (len(y), len(x)): infinite is red, NaN is white."""
    low, high = limits
    colors = pyplot().get_cmap("viridis").with_extremes(bad="white", over="red")
    # An infinite error is above the limits, every finite one at or below them.
    shown = np.where(np.isinf(log), high + 1, np.minimum(log, high))
    mesh = ax.pcolormesh(
        x, y, np.ma.masked_invalid(shown), cmap=colors, vmin=low, vmax=high, rasterized=True
    )
    ax.set(xscale="log", yscale="log")
    return mesh
