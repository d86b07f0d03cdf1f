"""The larger figures of tutorials 01 to 11: a function for each, which a tutorial calls once."""

import numpy as np

from tutorials.tools import figures, show
from tutorials.tools.figures import COLORS, THREAD


def free_and_anchor(model, camera, view, splats, free, anchor):
    """01: the Gaussians of the anchor, and the numbers that they and the anchor store."""
    figure, (left, right) = figures.pyplot().subplots(
        1, 2, figsize=(13, 4.8), layout="constrained", width_ratios=(1, 1.5)
    )
    show.picture(left, show.frame(model, camera, 0.3), camera, **view)
    show.ellipses(left, *splats, fc="none", ec=THREAD.color, lw=3)
    left.set_title("the trained scene, and three Gaussians of it")
    shades = dict(zip((*free, "$l_a$", "offsets", "feature"), (*COLORS, "0.7")))
    for y in (3, 2, 1):
        show.strip(right, free, y, shades)
    show.strip(right, anchor, 0, shades)
    bars = right.patches[:5] + right.patches[-4:-2] + right.patches[-1:]
    right.legend(bars, shades, ncols=4, loc="upper left")
    right.text(38, 0, "anchor 29: 37, and a share of the networks", color=THREAD.color, va="center")
    right.set(
        xlabel="numbers",
        yticks=(),
        ylim=(-0.5, 4.7),
        title="what they store as free Gaussians: 3 × 59",
    )
    right.grid(False)
    figures.show(figure, "01_offsets_free")


def walk(model, cameras, seen, own, degrees, colors, names, view):
    """02: the anchor's Gaussians from four sides, and their colours all around."""
    figure, axes = figures.pyplot().subplot_mosaic(
        "abcd;eeee", figsize=(12, 5.6), height_ratios=(2.2, 1), layout="constrained"
    )
    for name, i in zip("abcd", (6, 20, 42, 60)):
        show.picture(axes[name], show.frame(model, cameras[i], 0.3), cameras[i], **view)
        mean2d, cov2d, *_ = show.splats(seen[i], cameras[i], own)
        show.ellipses(axes[name], mean2d, cov2d, fc="none", ec=THREAD.color, lw=3)
        axes[name].set_title(f"camera at {degrees[i]}°")
    around = axes["e"]
    around.imshow(colors.swapaxes(0, 1), aspect="auto", extent=(-2.5, 357.5, 2.5, -0.5))
    around.set_yticks(range(3), names)
    around.set(
        xlabel="direction of the camera (degrees)",
        xticks=degrees[[6, 20, 42, 60]],
        title="the colours of its children",
    )
    around.grid(False)
    figures.show(figure, "02_view_walk", title="A walk around anchor 29")


def gradients_of_view(ring, of_length, of_direction):
    """02: the gradients of anchors around a camera."""
    figure, ax = figures.pyplot().subplots(figsize=(7.5, 7))
    ax.plot(0, 0, "k^", ms=14)
    ax.plot(*ring[:, :2].T, "o", color="0.5")
    for arrows, color in zip((of_length, of_direction), COLORS):
        places = *ring[:, :2].T, *arrows[:, :2].T
        ax.quiver(*places, color=color, angles="xy", scale_units="xy", scale=0.8, width=0.006)
    figures.finish(
        ax,
        xlabel="x (scene units)",
        ylabel="y (scene units)",
        aspect="equal",
        xlim=(-5.4, 5.4),
        ylim=(-5.4, 5.4),
        title="Gradients of anchors around a camera (triangle):\n"
        r"along the ray from $\bar\delta_{vc} = 1$, across it from $\bar d_{vc} = (1, 0, 0)$",
        title_size=13,
    )
    figures.show(figure, "02_view")


def opacities(model, camera, splats, alphas, kept, masked):
    """03: the children of the anchor and their opacities, and those of the scene."""
    figure, (left, middle, right) = figures.pyplot().subplots(
        1, 3, figsize=(13, 4.4), layout="constrained", width_ratios=(1, 1, 1.2)
    )
    mean2d, cov2d, *_ = splats
    x, y = mean2d[1]
    image = 0.4 + 0.6 * show.frame(model, camera, 0.3, 20)
    limits = {"xlim": (x - 5, x + 8), "ylim": (y + 6, y - 6)}
    show.picture(left, image, camera, **limits, title="its children")
    for style, which in (("-", slice(1, 4)), (":", slice(0, 1))):
        outline = {"fc": "none", "ec": THREAD.color, "lw": 3, "ls": style}
        show.ellipses(left, mean2d[which], cov2d[which], **outline)
    for j, ((u, v), alpha_j) in enumerate(zip(mean2d, alphas)):
        left.text(u, v, j, ha="center", va="center")
        middle.bar(j, alpha_j, color=THREAD.color)
    middle.axhline(0, color="k", lw=1)
    middle.set(
        xlabel="child of anchor 29",
        ylabel=r"opacity $\alpha$",
        title=r"drawn if $\alpha \geq \tau_\alpha = 0$",
    )
    bins = np.linspace(-0.5, 1, 31)
    colors, labels = ("0.75", COLORS[1]), ("kept", "masked")
    right.hist((kept, masked), bins, stacked=True, color=colors, label=labels)
    right.set(xlabel=r"opacity $\alpha$", ylabel="children", yscale="log")
    right.set_title("all children of the scene")
    right.legend(loc="upper left")
    figures.show(figure, "03_opacity_and_masking")


def slopes_of_tanh(reach, exact, stable, textbook):
    """03: the slope of tanh in two forms, in single precision."""
    figure, ax = figures.pyplot().subplots(figsize=(9, 5))
    ax.semilogy(reach, exact, color="0.6", lw=8, label="exact")
    ax.semilogy(reach, stable, color=COLORS[0], label=r"$4e/(1+e)^2$, single precision")
    lost = textbook == 0
    label = "$1 - \\alpha^2$,\nsingle precision"
    ax.semilogy(reach[~lost], textbook[~lost], color=COLORS[1], label=label)
    ax.axvline(reach[lost][0], color=COLORS[1], ls="--", label="exactly 0 from here on")
    ax.set(
        xlabel=r"output of the network $\psi_\alpha$",
        ylabel=r"slope $\partial\alpha/\partial\psi_\alpha$",
        title=r"$1 - \alpha^2$ switches the gradient off, $4e/(1+e)^2$ does not",
    )
    figures.label(ax, (22, 1e-25), (23.5, 1e-18), (0, 1e-14), (10, 1e-3))
    figures.show(figure, "03_opacity_and_masking_slope")


def paths(model, camera, view, places, time, height, fits):
    """05: the paths of the anchor's children, and the height of one as sums of waves."""
    figure, (left, right) = figures.pyplot().subplots(
        1, 2, figsize=(12.5, 4.8), layout="constrained", width_ratios=(1, 1.1)
    )
    image = 0.4 + 0.6 * show.frame(model, camera, 0)
    show.picture(left, image, camera, **view, title="the paths of anchor 29's children")
    for path in show.to_pixels(places, camera).swapaxes(0, 1):
        left.plot(*path.T, color=THREAD.color)
        left.plot(*path[::25].T, "o", ms=5, color=THREAD.color)
    name = f"child {THREAD.child}"
    right.plot(time, height, color=THREAD.color, lw=9, alpha=0.4, label=name)
    for L, (curve, error) in fits.items():
        right.plot(time, curve, label=f"$L_t = {L}$, rms error {error:.3f}")
    right.set(
        xlabel="time $t$",
        ylabel="height (scene units)",
        title=f"the height of {name}, as sums of waves",
    )
    right.legend(fontsize=11)
    figures.show(figure, "05_positional_encoding_and_deformation")


def numbers_and_noise(features, symbols, q, probability):
    """07: the features of the anchor and the reach of noise; probabilities of the fifth."""
    figure, (left, right) = figures.pyplot().subplots(1, 2, figsize=(13, 4.6), layout="constrained")
    bars = {"fmt": "o", "ms": 3, "color": THREAD.color, "ecolor": "0.6", "elinewidth": 9}
    left.errorbar(range(len(features)), features, q / 2, **bars)
    for i, symbol in enumerate(symbols):
        left.annotate(f"{symbol}", (i, features[i]), (6, 6), textcoords="offset points")
    left.set(
        xlabel="feature of anchor 29",
        ylabel="value (units of the feature)",
        title=f"integers, times q = {q:.3f}, and the reach of noise",
    )
    line, bins = np.linspace(-20, 20, 401), np.arange(-20, 21)
    right.plot(line, probability(line), color=COLORS[0])
    right.plot(bins, probability(bins), "o", color=COLORS[1])
    right.plot(symbols[4], probability(symbols[4]), "o", ms=13, color=THREAD.color)
    right.set(
        xlabel="value of its fifth feature (steps $q$)",
        ylabel="probability of one step",
        title="one curve for noisy values and for rounded ones",
    )
    figures.show(figure, "07_noise_and_rounding")


def signs_of_grid(model, x_29, values, h_29):
    """09: signs of one grid with h between them, and the context of the anchor."""
    figure, (left, right) = figures.pyplot().subplots(1, 2, figsize=(12, 5), layout="constrained")
    (x_0, y_0, _), (x_1, y_1, _) = model.box
    style = {"origin": "lower", "extent": (x_0, x_1, y_0, y_1), "cmap": "PuOr", "alpha": 0.75}
    left.imshow(values, **style)
    corners = np.meshgrid(np.linspace(x_0, x_1, 16), np.linspace(y_0, y_1, 16))
    nodes = np.stack(corners, axis=-1)
    positive = model.grids[1][:, 0].reshape(16, 16) >= 0
    left.plot(*nodes[positive].T, "P", ms=8, color="k")
    left.plot(*nodes[~positive].T, "s", ms=6, color="w", mec="k")
    cell = (np.abs(nodes - x_29[:2]) < nodes[1, 1] - nodes[0, 0]).all(axis=-1)
    left.plot(*nodes[cell].T, "o", ms=17, mfc="none", mec=THREAD.color, mew=2.5)
    left.plot(*x_29[:2], "o", ms=11, color=THREAD.color)
    left.set(xlabel="x (scene units)", ylabel="y (scene units)")
    left.set_title("signs (+ and squares) and h between them")
    names = [f"{axes}, {i}" for axes, _ in model.design.grid for i in (1, 2)]
    right.barh(names, h_29[0], color=THREAD.color)
    right.invert_yaxis()
    right.set(title="$h$ of anchor 29", xlim=(-1.1, 1.1))
    figures.show(figure, "09_hash_grid")


def tails_and_digits(distance, bits, widths, errors):
    """10: the bits of four forms far from the mean, and the digits of two in narrow bins."""
    figure, (tails, digits) = figures.pyplot().subplots(
        1, 2, figsize=(12, 4.8), layout="constrained"
    )
    for (label, values), style in zip(bits.items(), ("-", "--", "--", ":")):
        tails.plot(distance[0], np.minimum(values[0], 150), style, label=label)
    tails.set(
        xlabel=r"distance from $\mu$ (in $\sigma$)",
        ylabel="bits (infinite: 150)",
        title="The printed formula becomes infinite",
    )
    for label, wrong in errors.items():
        digits.loglog(widths, wrong + 1e-17, label=label)
    digits.set(
        xlabel=r"width of the bin $q/\sigma$",
        ylabel="relative error of the probability",
        title="The narrower the bin, the fewer digits remain",
    )
    tails.legend(fontsize=11)
    digits.legend(fontsize=11)
    figures.show(figure, "10_prior_and_likelihood")


def bits_of_signs_and_anchor(positive_share, groups):
    """11: what a sign costs and which slope it feels; the bits of the anchor's numbers."""
    figure, axes = figures.pyplot().subplot_mosaic(
        [["cost", "bits"], ["slope", "bits"]],
        figsize=(12, 5),
        layout="constrained",
        width_ratios=(1, 1.3),
    )
    share = np.linspace(0.005, 0.995, 199)
    cost = -share * np.log2(share) - (1 - share) * np.log2(1 - share)
    axes["cost"].plot(share, cost)
    axes["cost"].plot(positive_share, np.interp(positive_share, share, cost), "ko", ms=8)
    axes["cost"].set(ylabel="bits per sign", title="Descent drives the signs to the majority")
    axes["slope"].plot(share, 0.5 * np.log2((1 - share) / share), color=show.STEP)
    axes["slope"].set(
        ylim=(-3, 3),
        xlabel="share of positive entries $p_+$",
        ylabel="slope in $\\theta$\n(bits per unit)",
    )
    start = 0
    for (name, group), alpha in zip(groups.items(), (1, 0.5, 0.3, 0.8)):
        place = start + np.arange(len(group))
        axes["bits"].bar(place, group, color=THREAD.color, alpha=alpha, label=name)
        start += len(group)
    axes["bits"].set(xlabel="number", ylabel="bits", title="the bits of anchor 29")
    axes["bits"].legend(fontsize=11)
    figures.show(figure, "11_rate")
