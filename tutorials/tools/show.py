"""Figures and drawings of a trained model from the inside, for the tour and for tutorials.

The first functions compute what is drawn. The next draw on axes, in the pixels of the camera. The
last fill a whole figure, whose titles say the numbers that a caption may quote; `view` holds the
limits of its pictures, {"xlim": ..., "ylim": ...}, which leave out what is empty.

A colour means the same in every drawing, and the same as in the drawing of the architecture.
"""

from dataclasses import replace

import numpy as np
from matplotlib.collections import EllipseCollection, LineCollection
from scipy.special import ndtr

from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import encode, quantised_of
from p4dgs_ref.equations import hash_grid
from p4dgs_ref.model import context
from p4dgs_ref.report.figures import COLORS
from p4dgs_ref.report.inspect import anchor_bits, symbol_bits
from p4dgs_ref.splatting import compositing, render
from p4dgs_ref.splatting.settings import EXACT, FAST
from p4dgs_ref.training.objective import psnr
from p4dgs_ref.training.presets import PAPER_SYNTHETIC
from tutorials.tools import figures

SPACE, STEP, TIME, RATE, CONTEXT, SPLAT, ANCHOR = COLORS
GREY, PALE = "#606060", "#d9d9d9"
OWN = figures.THREAD.color  # of the anchor that leads through all pages
AMOUNT = "viridis"  # the colours of an amount: bits, distances, deviations
PARTS = {  # of an anchor's bits: shades of RATE
    "position, masks": "#b0b0b0",
    "feature": "#7a2f58",
    "scales": "#a8578a",
    "offset scales": "#cc79a7",
    "offsets": "#e8bfd6",
}
STYLE = {  # of the tour's pictures
    **figures.STYLE,
    "font.size": 16,
    "axes.titlesize": 18,
    "figure.dpi": 100,
    "axes.grid": False,
}
BARE = {"xticks": (), "yticks": (), "frame_on": False}  # axes of which nothing is drawn
MIN_SHARE = 0.01  # of a pixel: a Gaussian that gives less to it is not drawn


# --- what is drawn --------------------------------------------------------------------------------
def heat_image(model, colors, camera, t, settings=FAST):
    """Return the model at time t over white, (H, W, 3), in the colours (A, 3) of its anchors."""
    g = model.gaussians(t, camera)
    (image, *_), _ = render.forward(
        g.x,
        g.s,
        g.r,
        g.alpha,
        colors[g.index // model.design.k],
        camera,
        np.ones(3),
        settings,
        "occlusion" in model.design.effects,
    )
    return image


def enlarged(camera, zoom):
    """The camera with `zoom` times as many pixels in each direction."""
    lengths = {name: zoom * getattr(camera, name) for name in ("f_x", "f_y", "width", "height")}
    middle = {name: zoom * (getattr(camera, name) + 0.5) - 0.5 for name in ("c_x", "c_y")}
    return replace(camera, **lengths, **middle)


def frame(model, camera, t, zoom=8, colors=None):
    """The picture [zoom H, zoom W, 3] of a model at time t, or of its canonical Gaussians (None).

    The blur grows with the picture, which therefore shows what training saw, only finer. With
    `colors` [A, 3] every anchor has one colour, over white.
    """
    near, settings = enlarged(camera, zoom), FAST._replace(blur=FAST.blur * zoom**2)
    if colors is None:
        image = model.render(near, t, settings)
    else:
        image = heat_image(model, colors, near, t, settings)
    return np.clip(image, 0, 1)


def splats(g, camera, which=slice(None)):
    """The splats of the Gaussians that `which` selects, of all if it is left out.

    These are mean2d [N, 2], cov2d and conic [N, 3], depth and visible [N].
    """
    return [values[which] for values in render.project(g.x, g.s, g.r, camera, EXACT)[0]]


def to_pixels(x, camera):
    """Points x [..., 3] in pixels [..., 2]."""
    x = x @ camera.R.T + camera.T
    return x[..., :2] / x[..., 2:] * (camera.f_x, camera.f_y) + (camera.c_x, camera.c_y)


def front_to_back(g, camera, pixel):
    """What the splats of a pixel (column, row) give to it, from front to back.

    Returns their indices, their shares of the pixel, and the share of the background.
    """
    mean2d, _, conic, depth, visible = splats(g, camera)
    order = compositing.depth_order(depth, visible, True)
    rows = mean2d[order], conic[order], g.alpha[order], EXACT.alpha_max
    alphas = compositing.alphas(*rows, *np.array(pixel, float)[:, None])[0]
    T, behind = compositing.transmittances(alphas, True)
    return order, (alphas * T)[:, 0], behind[0]


def context_at(model, x):
    """The Context that the model predicts at any positions x [n, 3] in its box."""
    lo, hi = (corner.astype(float) for corner in model.box)
    located = hash_grid.locate(x, lo, hi, model.design.grid, [len(g) for g in model.grids])
    return context(model.design, model.networks, model.grids, located)[0]


# --- parts of drawings ----------------------------------------------------------------------------
def picture(ax, image, camera, **settings):
    """Show an image, of whatever size, on axes that count the pixels of the camera."""
    ax.imshow(image, extent=(-0.5, camera.width - 0.5, camera.height - 0.5, -0.5))
    ax.set(**BARE, **settings)


def scored_picture(ax, model, data, camera, t, truth, view, name):
    """Show what a model renders, with the bytes of its file and its PSNR against `truth`."""
    quality = psnr(model.render(camera, t), truth)
    title = f"{name}\n{len(data):,} bytes, {quality:.1f} dB"
    picture(ax, frame(model, camera, t), camera, **view, title=title)


def ellipses(ax, mean2d, cov2d, **style):
    """Draw splats as the ellipses of one standard deviation."""
    variances, axes = np.linalg.eigh(cov2d[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    height, width = 2 * np.sqrt(variances).T
    angles = np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    place = {"units": "xy", "offsets": mean2d, "offset_transform": ax.transData}
    ax.add_collection(EllipseCollection(width, height, angles, **place, **style))


def families(ax, model, camera, anchor, t=None):
    """Draw anchors, their children, and a line from each to its anchor; one family stands out."""
    g = model.gaussians(t, camera)
    parents = g.index // model.design.k
    anchors, children = (to_pixels(x, camera) for x in (model.anchors.x_a, g.x))
    lines, of_anchor = np.stack([anchors[parents], children], axis=1), parents == anchor
    for which, color, width, size in ((~of_anchor, SPACE, 0.8, 9), (of_anchor, OWN, 3, 70)):
        ax.add_collection(LineCollection(lines[which], colors=color, lw=width, zorder=1 + width))
        ax.scatter(*children[which].T, size, color, lw=0, zorder=2 + width)
    ax.scatter(*anchors.T, 26, ANCHOR, lw=0, zorder=3)
    ax.scatter(*anchors[anchor], 120, ANCHOR, edgecolor=OWN, lw=3, zorder=6)


def strip(ax, sizes, y, colors, labels=()):
    """Draw {name: size} as one bar from 0 on, in {name: colour}.

    `labels` is {name: (height of the text's upper end, text)}; a name may be missing.
    """
    for end, (name, size) in zip(np.cumsum([*sizes.values()]), sizes.items()):
        ax.barh(y, size, 0.7, end - size, color=colors[name], edgecolor="white")
        if name in labels:
            ax.text(end - size / 2, *labels[name], ha="center", va="top", fontsize=14)


def distribution(ax, mu, sigma, symbol, reach=14):
    """Draw the probabilities of symbols, whose mean and deviation are in steps.

    The bar of the one that was coded stands out. Returns its bits.
    """
    n = np.arange(-reach, reach + 1)
    p = ndtr((n + 0.5 - mu) / sigma) - ndtr((n - 0.5 - mu) / sigma)
    ax.bar(n, p, 0.85, color=np.where(n == symbol, CONTEXT, PALE))
    return float(-np.log2(p[symbol + reach]))


def compared(name, shown, camera, t, view, anchor=figures.THREAD.index):
    """Save a figure of {title: model} side by side, in which one anchor's splats stand out.

    `anchor` is None where the models are of several trainings, in which an index says nothing.
    """
    size = {"figsize": (3.3 * len(shown), 3.9), "layout": "constrained"}
    figure, axes = figures.pyplot().subplots(1, len(shown), **size)
    for ax, (title, model) in zip(axes, shown.items()):
        g = model.gaussians(t, camera)
        mean2d, cov2d, *_ = splats(g, camera, g.index // model.design.k == anchor)
        picture(ax, frame(model, camera, t), camera, **view, title=title)
        ellipses(ax, mean2d, cov2d, fc="none", ec=OWN, lw=2.5)
    figures.show(figure, name)


# --- whole figures --------------------------------------------------------------------------------
def anchors(figure, model, camera, anchor, view):
    """Anchors and children in canonical space, and the ellipses of the children; one stands out."""
    left, right = figure.subplots(1, 2)
    g, image = model.gaussians(None, camera), 0.5 * frame(model, camera, None) + 0.5
    picture(left, np.ones_like(image), camera, **view)
    left.set(
        title=f"{model.count} anchors (black), {len(g.x)} children (blue)",
        xlabel=f"here k = {model.design.k}: {model.anchors.mask.sum(axis=1).mean():.1f} are left\n"
        f"in the paper k = {PAPER_SYNTHETIC.k}: 3 to 4 are left",
    )
    families(left, model, camera, anchor)
    picture(right, image, camera, **view, title="the children, drawn as Gaussians")
    right.set_xlabel(
        "anchors save 87 % of T-Rex's file (paper, Table 3),\n"
        "here 85 % of the Gaussians' bytes, but not of the file"
    )
    of_anchor = g.index // model.design.k == anchor
    others = ~of_anchor
    for which, colors, width in ((others, 0.7 * g.color[others], 1), (of_anchor, OWN, 4)):
        ellipses(right, *splats(g, camera, which)[:2], fc="none", ec=colors, lw=width)


def prediction(figure, file, cameras, t, anchor):
    """The feature of an anchor of a Quantised model, and its Gaussians from {side: camera}."""
    feature, *sides = figure.subplots(1, 1 + len(cameras))
    symbols = file.symbols[anchor, : file.model.design.d]
    feature.barh(-np.arange(len(symbols)), symbols, color=PARTS["feature"])
    feature.set(title=f"one feature: {len(symbols)} integers", xlabel="integer", yticks=())
    feature.locator_params(axis="x", integer=True)
    for ax, (side, camera) in zip(sides, cameras.items()):
        g = file.model.gaussians(t, camera)
        children = g.index // file.model.design.k == anchor
        mean2d, cov2d, *_ = splats(g, camera, children)
        x, y = mean2d.mean(axis=0)
        limits = {"xlim": (x - 8, x + 8), "ylim": (y + 8, y - 8)}
        picture(ax, 0.3 * frame(file.model, camera, t, 20) + 0.7, camera, **limits)
        ellipses(ax, mean2d, cov2d, fc=g.color[children], ec=OWN, lw=3)
        ax.set_title(f"its {children.sum()} Gaussians {side}")


def time(figure, model, camera, t, view):
    """Canonical space, the paths of all Gaussians over a second, and their heights.

    The colour of a path is the time, as in the viewer; that of a height is the Gaussian's own.
    """
    a, c, b = figure.subplot_mosaic("ac;bc", width_ratios=(1, 1.2)).values()
    picture(a, frame(model, camera, None), camera, **view, title="canonical: no time yet")
    image, times = 0.3 * frame(model, camera, t) + 0.7, np.linspace(0, 1, 61)
    picture(b, image, camera, **view, title="paths of one Gaussian in five")
    x, color = (
        np.array([model.gaussians(at, camera).x for at in times]),
        model.gaussians(t, camera).color,
    )
    # Late ones are drawn first and wider, and few of all, so that the colours can be seen.
    places = to_pixels(x[::-1, ::5], camera)
    pieces = np.stack([places[:-1], places[1:]], axis=2).reshape(-1, 2, 2)
    ends = np.repeat(times[:0:-1], places.shape[1])
    lines = LineCollection(pieces, cmap=AMOUNT, lw=2 + 5 * ends, rasterized=True)
    lines.set_array(ends)
    paths = b.add_collection(lines)
    figure.colorbar(paths, ax=b, label="time t", aspect=6)
    heights = np.stack(np.broadcast_arrays(times, x[:, :, 2].T), axis=2)
    c.add_collection(LineCollection(heights, colors=color, lw=0.8, rasterized=True))
    c.autoscale()
    c.set(
        title=f"heights: {(np.ptp(x[:, :, 2], axis=0) > 0.1).sum()} of {len(color)} Gaussians move",
        xlabel="time t\nmotion: 33.9 dB instead of 20.0, for 13,715 bytes",
        ylabel="height (scene units)",
    )


def pixel(figure, model, camera, t, at):
    """One pixel (column, row), the Gaussians that it sees, and what each of them gives to it."""
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    g, (x, y) = model.gaussians(t, camera), at
    order, shares, behind = front_to_back(g, camera, at)
    mixed = shares @ g.color[order] + behind * model.background
    left_over, seen = 100 * (1 - np.append(0, np.cumsum(shares))), shares > MIN_SHARE
    first, shares, left_over = order[seen], shares[seen], left_over[np.append(seen, True)]
    image = 0.3 * frame(model, camera, t, 20) + 0.7
    picture(left, image, camera, xlim=(x - 8, x + 8), ylim=(y + 8, y - 8))
    ellipses(left, *splats(g, camera, first)[:2], fc="none", ec=0.8 * g.color[first], lw=4)
    left.plot(x, y, "s", ms=24, mfc=mixed, mec=ANCHOR, mew=4)
    left.set_title(f"one pixel sees {len(first)} of {len(g.x)} Gaussians")
    right.bar(np.arange(1, len(shares) + 1), 100 * shares, color=g.color[first], edgecolor=GREY)
    edges = np.arange(len(left_over) + 1) + 0.4
    right.stairs(left_over, edges, color=ANCHOR, lw=3, baseline=None)
    right.set(
        title="bars: share of each Gaussian\nline: light that is left",
        xlabel="Gaussians, from front to back",
        ylabel="% of the pixel",
    )


def steps(figure, model, camera, t, truth, view, factors=(1, 4, 16)):
    """The picture with coarser steps, its bytes and PSNR, and the values that features can have."""
    axes = figure.subplots(2, len(factors), height_ratios=(2.2, 1)).T
    Q_0, d = np.array(model.design.Q_0), model.design.d
    for (top, bottom), factor in zip(axes, factors):
        data = encode(replace(model, design=replace(model.design, Q_0=tuple(factor * Q_0))))
        file = quantised_of(read_container(data))
        scored_picture(top, file.model, data, camera, t, truth, view, f"steps × {factor}")
        values, counts = np.unique(file.symbols[:, :d], return_counts=True)
        bottom.bar(factor * values, 100 * counts / counts.sum(), 0.85 * factor, color=STEP)
        bottom.set(
            title=f"{len(values)} different integers",
            xlabel="feature, in multiples of\nthe left column's step",
            ylabel="% of all",
            xlim=(-25, 25),
        )


def knowledge(figure, file, side=160):
    """Signs of the hash grid, sigma of the features at height 0, and two symbols' distributions."""
    a, b, *both = figure.subplot_mosaic("abc;abd", width_ratios=(1, 1, 1.05)).values()
    model, d = file.model, file.model.design.d
    (x, y, _), (x_end, y_end, _) = model.box
    place = {"origin": "lower", "extent": (x, x_end, y, y_end)}
    signs = model.grids[1][:, 0].reshape(2 * [model.design.grid[1][1]])
    a.imshow(signs, cmap="gray_r", vmin=-1.6, vmax=1.6, **place)
    a.set(
        title=f"{signs.size} of {sum(map(np.size, model.grids)):,} signs,\nseen from above",
        xlabel="x (scene units)",
        ylabel="y (scene units)",
    )
    plane = np.meshgrid(np.linspace(x, x_end, side), np.linspace(y, y_end, side), 0.0)
    over = context_at(model, np.stack(plane, axis=3).reshape(-1, 3))
    sigma = (over.sigma[:, :d] / over.q[:, :1]).mean(axis=1).reshape(side, side)
    image = b.imshow(sigma, cmap=AMOUNT, **place)
    figure.colorbar(image, ax=b, location="bottom", label="σ (steps)")
    near = np.abs(model.anchors.x_a[:, 2]) < 0.15
    b.plot(*model.anchors.x_a[near, :2].T, "o", color="white", mec=ANCHOR, ms=8)
    b.set(title="σ that they predict,\nand anchors there", xlabel="x (scene units)")
    at_anchors = context_at(model, model.anchors.x_a)
    mu, sigma = (
        values[:, :d] / at_anchors.q[:, :1] for values in (at_anchors.mu, at_anchors.sigma)
    )
    cheapest = symbol_bits(file)[:, :d].argmin()
    for ax, word, i in zip(both, ("sure", "unsure"), (cheapest, sigma.argmax())):
        bits = distribution(ax, mu.flat[i], sigma.flat[i], file.symbols[:, :d].flat[i])
        ax.set(
            title=f"{word}: σ = {sigma.flat[i]:.1f} steps\nthe integer costs {bits:.1f} bits",
            xlabel="integer",
            ylabel="probability",
        )


def bits(figure, data, camera, t, view):
    """Every anchor of a file in the colour of its bits, and what the bits are spent on.

    Returns axes for more.
    """
    left, right, more = figure.subplot_mosaic(
        "ab;ac", width_ratios=(1, 1.35), height_ratios=(1.7, 1)
    ).values()
    model, whole = anchor_bits(data)
    scale = left.scatter([], [], c=[], cmap=AMOUNT, vmin=whole.min(), vmax=whole.max())
    image = frame(model, camera, t, colors=scale.to_rgba(whole)[:, :3])
    picture(left, image, camera, **view, title="anchors coloured by their bits")
    figure.colorbar(scale, ax=left, location="left", label="bits")
    coded = symbol_bits(quantised_of(read_container(data)))
    groups = np.add.reduceat(coded, np.cumsum((0, *model.design.widths[:3])), axis=1)
    table = np.column_stack([whole - coded.sum(axis=1), groups])
    rows = table[whole.argmin()], table.mean(axis=0), table[whole.argmax()]
    for i, row in enumerate(rows):
        strip(right, dict(zip(PARTS, row)), i, PARTS)
    costs = [f"{w}: {sum(row):.0f}" for w, row in zip(("cheapest", "mean", "costliest"), rows)]
    right.set(yticks=range(3), yticklabels=costs, xlabel="bits of an anchor", ylim=(-0.5, 6.8))
    means = [f"{name}: {mean:.0f}" for name, mean in zip(PARTS, rows[1])]
    right.legend(
        right.patches[: len(PARTS)],
        means,
        ncols=2,
        handlelength=1,
        frameon=False,
        title="mean bits",
    )
    return more
