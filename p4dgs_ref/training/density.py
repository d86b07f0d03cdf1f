"""Density control: growing, re-seeding and pruning of anchors, masking of children (Q15, Q16).

All decisions rest on statistics that are summed over a window of views.
"""

from dataclasses import dataclass

import numpy as np

from ..equations import offsets

ROWS = ("x_a", "f_a", "log_s", "log_l", "O_a")  # the trained arrays with one row per anchor
MAX_LOG_SCALE = 0.05  # Scaffold-GS clamps log s_a to this in every adjustment (Q29)


@dataclass
class Statistics:
    """Sums over the views since they were last cleared."""

    visits: np.ndarray  # [A]  views in which the anchor took part
    opacity: np.ndarray  # [A, k]  positive opacities of its children
    gradient: np.ndarray  # [A, k]  lengths of the gradient of the projected centre, in NDC units
    seen: np.ndarray  # [A, k]  views in which the child was rendered in front of the camera

    @classmethod
    def empty(cls, A, k):
        """Return the statistics of A anchors with k children before the first view."""
        return cls(np.zeros(A), *np.zeros((3, A, k)))

    def collect(self, rendered, mean2d_bar, camera):
        """Add one view; `mean2d_bar` [N, 2] is per pixel; in NDC the image is two units wide."""
        self.visits += 1
        self.opacity += np.maximum(rendered.alpha, 0)
        x_bar, y_bar = mean2d_bar.T
        length = np.hypot(x_bar * camera.width / 2, y_bar * camera.height / 2)
        rows = rendered.index[rendered.visible]
        self.gradient.reshape(-1)[rows] += length[rendered.visible]
        self.seen.reshape(-1)[rows] += 1

    def clear_judged(self, preset):
        """Clear, in place, the sums to which enough views have contributed, and keep the others.

        This is Scaffold-GS's rule (Q16): gradients are cleared by child, opacities by anchor.
        """
        children, anchors = judged_children(self, preset), judged_anchors(self, preset)
        self.gradient[children] = self.seen[children] = 0
        self.opacity[anchors] = self.visits[anchors] = 0

    def with_rows(self, keep, count):
        """Return the statistics of the anchors that are kept, then of `count` new ones."""
        return Statistics(
            *(
                np.concatenate([sums[keep], np.zeros((count, *sums.shape[1:]))])
                for sums in vars(self).values()
            )
        )


def centers(p):
    """Return the centres [A, k, 3] of all children, Eq. (1)."""
    return offsets.forward(p["x_a"], p["O_a"], np.exp(p["log_l"]))[0]


def grow(p, statistics, preset, rng):
    """Return new anchors where projected centres have large gradients, {array name: new rows}.

    This is the rule of Scaffold-GS (Lu et al. 2024) with the constants of its code (Q16). Level i
    looks for free voxels of size voxel * max(grow_init // grow_hierarchy**i, 1) that contain a
    child with a gradient of at least gradient_threshold * (grow_hierarchy // 2)**i. Only a random
    share of the children, 1 - 0.5**(i+1), counts. Levels after the first are searched only if an
    anchor has been added. Each number of a new anchor's feature is the largest one among the
    anchors whose children are in its voxel.
    """
    x = centers(p).reshape(-1, 3)
    gradient = (statistics.gradient / np.maximum(statistics.seen, 1)).ravel()  # per view
    parents = np.repeat(p["f_a"], p["O_a"].shape[1], axis=0)
    x_a, f_a, log_size = p["x_a"][:0], p["f_a"][:0], np.zeros((0, 3))
    for level in range(preset.grow_depth):
        threshold = preset.gradient_threshold * (preset.grow_hierarchy // 2) ** level
        wanted = judged_children(statistics, preset).ravel() & (gradient >= threshold)
        wanted &= rng.random(len(x)) > 0.5 ** (level + 1)
        if level and not len(x_a):
            continue
        size = preset.voxel * max(preset.grow_init // preset.grow_hierarchy**level, 1)
        occupied = {*map(tuple, np.round(np.concatenate([p["x_a"], x_a]) / size).tolist())}
        largest = {}  # {free voxel: feature}
        for voxel, feature in zip(map(tuple, np.round(x[wanted] / size).tolist()), parents[wanted]):
            if voxel not in occupied:
                largest[voxel] = np.maximum(largest.get(voxel, feature), feature)
        if largest:
            voxels = sorted(largest)
            x_a = np.concatenate([x_a, np.array(voxels, x.dtype) * size])
            f_a = np.concatenate([f_a, [largest[voxel] for voxel in voxels]])
            log_size = np.concatenate([log_size, np.full((len(voxels), 3), np.log(size))])
    return {
        "x_a": x_a,
        "f_a": f_a,
        "log_s": log_size,
        "log_l": log_size,
        "O_a": np.zeros((len(x_a), *p["O_a"].shape[1:])),
    }


def judged_children(statistics, preset):
    """Return which children [A, k] were rendered often enough for a decision."""
    return statistics.seen > preset.grow_every * preset.success * 0.5


def judged_anchors(statistics, preset):
    """Return which anchors [A] took part in enough views of the window for a decision."""
    return statistics.visits > preset.grow_every * preset.success


def dead_anchors(statistics, mask, preset):
    """Return the anchors [A] whose kept children added up to less than min_opacity per view."""
    total = (statistics.opacity * mask).sum(axis=1)
    return judged_anchors(statistics, preset) & (total < preset.min_opacity * statistics.visits)


def faint_children(statistics, preset):
    """Return the children [A, k] whose mean positive opacity stayed below min_opacity (Q15)."""
    least = preset.min_opacity * statistics.visits[:, None]
    return judged_anchors(statistics, preset)[:, None] & (statistics.opacity < least)


def reseed(p, first, second, dead, statistics, rng):
    """Move dead anchors, in place, to children drawn at random in proportion to their gradients.

    A child with an opacity below zero is masked out and receives no gradient, so a dead anchor
    cannot recover. It starts again as a copy of the anchor that the chosen child belongs to, with
    zero Adam moments (`first`, `second`).
    """
    k = p["O_a"].shape[1]
    weight = statistics.gradient.ravel() * ~np.repeat(dead, k)
    if not weight.any():
        return
    parents = rng.choice(len(weight), size=dead.sum(), p=weight / weight.sum())
    copied = {name: p[name][parents // k] for name in ROWS}
    copied["x_a"] = centers(p).reshape(-1, 3)[parents]
    copied["O_a"] = 0
    for name, rows in copied.items():
        p[name][dead] = rows
        first[name][dead] = second[name][dead] = 0
