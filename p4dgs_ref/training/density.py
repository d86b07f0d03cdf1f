"""How many anchors there are: statistics over windows of views, growing, re-seeding, pruning, masking (Q15, Q16)."""

import numpy as np

ROWS = ("x_a", "f_a", "log_s", "log_l", "O_a")  # arrays with one row per anchor
LARGEST_LOG_SCALE = 0.05  # Scaffold-GS clamps log s_a to this at every adjustment


class Statistics:
    """Sums over the views since the last adjustment, per anchor and per child."""

    NAMES = ("visits", "opacity", "gradient", "seen")

    def __init__(self, A, k):
        self.visits = np.zeros(A)  # views in which the anchor took part
        self.opacity = np.zeros((A, k))  # positive opacities of its children
        self.gradient = np.zeros(
            (A, k)
        )  # lengths of the gradient of the projected centre, NDC units
        self.seen = np.zeros((A, k))  # views in which the child was rendered in front of the camera

    def collect(self, seen, mean2d_bar, width, height):
        """Add one view; `mean2d_bar` (N, 2) is per pixel, NDC spans two units over the image (3DGS)."""
        self.visits += 1
        self.opacity += np.maximum(seen.alpha, 0)
        length = np.hypot(mean2d_bar[:, 0] * width / 2, mean2d_bar[:, 1] * height / 2)
        rows = seen.index[seen.visible]
        self.gradient.reshape(-1)[rows] += length[seen.visible]
        self.seen.reshape(-1)[rows] += 1

    def mean_gradient(self):
        """Mean length per child (A, k), zero where a child was never seen."""
        return self.gradient / np.maximum(self.seen, 1)

    def with_rows(self, keep, added):
        """The statistics of the kept anchors, followed by empty rows for new ones."""
        other = Statistics(added, self.opacity.shape[1])
        for name in self.NAMES:
            setattr(other, name, np.concatenate([getattr(self, name)[keep], getattr(other, name)]))
        return other

    def clear(self):
        for name in self.NAMES:
            getattr(self, name)[:] = 0


def grow(p, statistics, preset, rng):
    """New anchors where projected centres pull hardest, on ever finer lattices: {array name: new rows}.

    Reference  Scaffold-GS (Lu et al. 2024) and its code's constants; Q16.  Per level i: voxel epsilon *
               grow_init / hierarchy^i, threshold * (hierarchy / 2)^i, a random share of candidates kept; levels after
               the first only once something was added; a new anchor takes the largest feature of its voxel's parents.
    """
    x = (p["x_a"][:, None] + p["O_a"] * np.exp(p["log_l"])[:, None]).reshape(-1, 3)
    gradient = statistics.mean_gradient().ravel()
    eligible = statistics.seen.ravel() > preset.grow_every * preset.success * 0.5
    taken, features, sizes = [], [], []
    for level in range(preset.grow_depth):
        threshold = preset.gradient_threshold * (preset.grow_hierarchy // 2) ** level
        wanted = eligible & (gradient >= threshold) & (rng.random(len(x)) > 0.5 ** (level + 1))
        if level and not taken or not wanted.any():
            continue
        size = preset.voxel * max(preset.grow_init // preset.grow_hierarchy**level, 1)
        cells, cell = np.unique(np.round(x[wanted] / size), axis=0, return_inverse=True)
        largest = np.full((len(cells), p["f_a"].shape[1]), -np.inf, p["f_a"].dtype)
        np.maximum.at(largest, cell.ravel(), np.repeat(p["f_a"], p["O_a"].shape[1], axis=0)[wanted])
        present = np.round(np.concatenate([p["x_a"], *taken]) / size)
        free = ~_among(cells, present)
        if free.any():
            taken.append((cells[free] * size).astype(p["x_a"].dtype))
            features.append(largest[free])
            sizes.append(np.full(free.sum(), np.log(size)))
    if not taken:
        return empty_rows(p)
    x_a, log_size = np.concatenate(taken), np.concatenate(sizes)
    reach = np.repeat(log_size[:, None], 3, axis=1).astype(x_a.dtype)
    return {
        "x_a": x_a,
        "f_a": np.concatenate(features),
        "log_s": reach,
        "log_l": reach,
        "O_a": np.zeros((len(x_a), *p["O_a"].shape[1:]), x_a.dtype),
    }


def _among(cells, present):
    """Which rows of `cells` occur in `present`."""
    both, which = np.unique(np.concatenate([present, cells]), axis=0, return_inverse=True)
    occupied = np.zeros(len(both), bool)
    occupied[which.ravel()[: len(present)]] = True
    return occupied[which.ravel()[len(present) :]]


def empty_rows(p):
    return {name: p[name][:0] for name in ROWS}


def dead_anchors(statistics, mask, preset):
    """Anchors whose kept children's opacities together stayed below min_opacity, of those seen often (A,) bool."""
    often = statistics.visits > preset.grow_every * preset.success
    return often & (
        (statistics.opacity * mask).sum(axis=1) < preset.min_opacity * statistics.visits
    )


def faint_children(statistics, preset):
    """Children whose mean positive opacity over the window stayed below min_opacity (A, k) bool (Q15)."""
    often = statistics.visits > preset.grow_every * preset.success
    return often[:, None] & (statistics.opacity < preset.min_opacity * statistics.visits[:, None])


def reseed(p, first, second, dead, statistics, rng):
    """Move dead anchors to children drawn by their pull on the image, as copies of their anchors, in place.

    tanh opacity has no way back from below zero: nothing masked out receives a gradient.  A dead anchor thus starts
    anew where it is of use, and so do its Adam moments (`first`, `second`).
    """
    pull = statistics.gradient.ravel() * ~np.repeat(dead, p["O_a"].shape[1])
    if not dead.any() or not pull.any():
        return
    chosen = rng.choice(len(pull), size=dead.sum(), p=pull / pull.sum())
    parent, child = np.divmod(chosen, p["O_a"].shape[1])
    x = p["x_a"][parent] + p["O_a"][parent, child] * np.exp(p["log_l"][parent])
    for name in ROWS:
        p[name][dead] = {"x_a": x, "O_a": 0}.get(name, p[name][parent])
        first[name][dead], second[name][dead] = 0, 0
