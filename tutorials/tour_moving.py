"""The two moving pictures of the tour: tutorials/tour/bin.gif and noise.gif.

`tutorials.tools.tour` writes them.
"""

import numpy as np
from scipy.special import ndtr

from p4dgs_ref.report import figures
from p4dgs_ref.scenes.files import write_image
from tutorials.tools import show
from tutorials.tools.shared import in_few_colors

SIGMA = 2.0  # steps


@figures.figure_style(show.STYLE)
def frame(draw, *values):
    """The pixels of a figure of two panels that `draw` fills."""
    figure = figures.new_figure(figsize=(7, 3.6), layout="constrained")
    draw(*figure.subplots(1, 2), *values)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]


def bin_under_bell(bell, counter, place, places):
    """The bin at `place` under the bell, and the bits of all places so far."""
    x, so_far = np.linspace(-8, 8, 400), places[places <= place]
    inside = np.abs(x - place) <= 0.5
    mass = ndtr((so_far + 0.5) / SIGMA) - ndtr((so_far - 0.5) / SIGMA)
    density = np.exp(-((x / SIGMA) ** 2) / 2)
    bell.plot(x, density, color=show.GREY)
    bell.fill_between(x[inside], density[inside], color=show.CONTEXT)
    bell.set(title=f"bin: {mass[-1]:.2%} of the bell", xlabel="number (steps)", yticks=())
    counter.plot(so_far, -np.log2(mass), ".-", color=show.CONTEXT)
    counter.set(
        title=f"it costs {-np.log2(mass[-1]):.1f} bits",
        xlabel="number (steps)",
        xlim=(-8, 8),
        ylim=(0, 14),
    )


def noise_to_rounding(stored, error, q, share, f, u):
    """Numbers f with noise u q, of which `share` has turned into the error of rounding."""
    value = (1 - share) * (f + u * q) + share * np.rint(f / q) * q
    stored.plot(f, value, ".", ms=4, color=show.STEP)
    name = {0: "noise", 1: "rounded"}.get(share, "partly rounded")
    stored.set(title=f"{name}, q = {q:.2f}", xlabel="number", ylabel="stored", ylim=(-1.4, 1.4))
    error.axvspan(-q / 2, q / 2, color=show.PALE)
    error.hist(value - f, 32, (-0.4, 0.4), color=show.STEP)
    error.set(title="error (grey: a step)", yticks=(), ylim=(0, 250))


def write(folder):
    """Write both moving pictures into a folder."""
    places, growing = np.linspace(-7, 7, 29), np.geomspace(0.05, 0.6, 12)
    f, u = np.linspace(-1, 1, 1000), np.random.default_rng(0).random(1000) - 0.5
    phases = [(q, 0) for q in growing] + [(0.6, share) for share in np.linspace(0, 1, 7)]
    phases += [(q, 1) for q in growing[::-1]]
    moving = {
        "bin": [frame(bin_under_bell, place, places) for place in places],
        "noise": [frame(noise_to_rounding, *phase, f, u) for phase in phases],
    }
    for name, frames in moving.items():
        frames = in_few_colors(np.array(frames))  # in all of them the same, which takes half
        write_image(folder / f"{name}.gif", frames, duration=150, loop=0)
