"""Which effects do the pictures call for?  Inferred from images, cameras and times alone, never from the scene's list.

Silhouettes decide about motion.  If nothing moves and nothing turns to the viewer, every pixel of the foreground
looks at some point that is foreground in all other views too; the points that are form the visual hull (Laurentini
1994).  Foreground that the hull leaves bare is a contradiction, hence a proof that something changed.  The colours that
the views show of one point of the hull's surface decide, where nothing contradicts, about a dependence on the view.
What pictures cannot tell is kept: a model with an effect too many is larger, one with an effect too few is wrong.
"""

import numpy as np
from scipy.ndimage import binary_dilation

from .. import effects as fx
from ..scenes.scene import MODEL_EFFECTS

GRID = 72  # points of the hull along an axis
BARE = (
    0.002  # share of the foreground that may stay bare: the lattice may lose the rim of a thin part
)
COLOR_CHANGE = (
    0.05  # of 1: what texture and a hull that is fatter than the body make of one point's colours
)
QUANTILE = (
    0.75  # of all points: a quarter may lie in concavities, where the hull is not the surface
)
WITNESSES = 6  # views that must see a point before its colours are compared
POINTS = 600  # surface points whose colours are compared
AROUND = np.ones((3, 3), bool)


def suggest(scene):
    """The model's effects that a scene's training views call for, each with a reason.

    Takes      a Scene; its list of effects is not read
    Returns    [{effect, called_for, evidence}], one for each of the closed list in its order; evidence is one sentence
               with a number.  Where the pictures cannot tell it says so, and the effect is kept
    """
    views = scene.train
    times = np.array([view.time for view in views])
    masks = [foreground(view, scene.background) for view in views]
    bare, change = evidence_of_change(views, masks)
    found = {
        **motion(times, bare, change),
        "view_color": view_color(bare, change),
        "view_geometry": view_geometry(times, bare),
        "occlusion": (
            True,
            f"kept: which of two surfaces hides the other cannot be excluded from "
            f"{len(views)} pictures",
        ),
        "background": background(views, masks, scene.background),
    }
    return [
        {"effect": effect, "called_for": called, "evidence": text}
        for effect, (called, text) in ((name, found[name]) for name in MODEL_EFFECTS)
    ]


def foreground(view, color):
    """Where a view shows more than its background (H, W) bool: by its alpha, otherwise by its colour."""
    return (
        view.alpha > 0.5
        if view.alpha is not None
        else np.abs(view.image - color).max(axis=2) > 0.02
    )


def evidence_of_change(views, masks):
    """(share of the foreground that the hull leaves bare, change of a point's colour), None for what is unknown."""
    if len(views) < 2 or all(mask.all() for mask in masks):
        return None, None
    hull, size = visual_hull(views, masks)
    depths = [depth_map(hull, size, view.camera) for view in views]
    total = sum(int(mask.sum()) for mask in masks)
    if not total:
        return None, None
    bare = sum(int((mask & np.isinf(depth)).sum()) for mask, depth in zip(masks, depths)) / total
    return bare, color_change(views, masks, hull, size, depths)


def visual_hull(views, masks):
    """Points (M, 3) of a lattice that no view shows as background, and the lattice's step.

    A view that does not see a point says nothing about it.
    """
    middle, reach = looked_at(views)
    step = 2 * reach / (GRID - 1)
    line = np.linspace(-reach, reach, GRID)
    points = middle + np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    for view, mask in zip(views, masks):
        row, column, depth, inside = pixels_of(points, view.camera)
        keep = ~inside
        keep[inside] = mask[row[inside], column[inside]]
        points = points[keep & (depth > 0)]
    return points, step


def looked_at(views):
    """The point nearest to all optical axes, and the radius about it that the narrowest view still shows."""
    axes, centers = (
        np.array([getter(view.camera) for view in views])
        for getter in (lambda camera: camera.R[2], lambda camera: camera.center)
    )
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = np.linalg.lstsq(
        across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=None
    )[0]
    opening = [
        max(view.camera.width / view.camera.f_x, view.camera.height / view.camera.f_y) / 2
        for view in views
    ]
    return middle, float(np.median(np.linalg.norm(centers - middle, axis=1) * opening))


def pixels_of(points, camera):
    """Row, column, depth of points, and whether they fall into the picture."""
    x, y, z = (points @ camera.R.T + camera.T).T
    near = np.where(z > 1e-6, z, np.inf)
    column, row = (
        np.rint(focal * a / near + c).astype(np.int64)
        for focal, a, c in ((camera.f_x, x, camera.c_x), (camera.f_y, y, camera.c_y))
    )
    inside = (
        (z > 1e-6) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    )
    return row, column, z, inside


def depth_map(hull, step, camera):
    """Depth of the hull's nearest point at every pixel, infinity where none projects into the pixel or beside it."""
    row, column, z, inside = pixels_of(hull, camera)
    depth = np.full((camera.height + 2, camera.width + 2), np.inf)
    reach = int(np.ceil(step * max(camera.f_x, camera.f_y) / np.median(z) / 2)) if len(z) else 1
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            np.minimum.at(
                depth,
                (
                    np.clip(row[inside] + 1 + dv, 0, camera.height + 1),
                    np.clip(column[inside] + 1 + du, 0, camera.width + 1),
                ),
                z[inside],
            )
    return depth[1:-1, 1:-1]


def color_change(views, masks, hull, step, depths):
    """How much the colour of one surface point differs between the views that see it: QUANTILE of standard deviations.

    A view sees a point if no point of the hull lies before it and its pixel is well inside the foreground.
    """
    inner = [~binary_dilation(~mask, AROUND) for mask in masks]
    shown = np.full((len(views), len(hull), 3), np.nan)
    for color, view, depth, mask in zip(shown, views, depths, inner):
        row, column, z, inside = pixels_of(hull, view.camera)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        seen = inside & mask[row, column] & (z <= depth[row, column] + step)
        color[seen] = view.image[row[seen], column[seen]]
    often = np.flatnonzero(np.isfinite(shown[:, :, 0]).sum(axis=0) >= WITNESSES)
    if not len(often):
        return None
    chosen = often[np.linspace(0, len(often) - 1, min(POINTS, len(often))).astype(int)]
    middle = np.nanmedian(shown[:, chosen], axis=0)  # a view that looks past the body is no witness
    spread = np.nanmedian(np.abs(shown[:, chosen] - middle), axis=0).max(axis=1)
    return float(
        np.quantile(1.4826 * spread, QUANTILE)
    )  # of a normal distribution's standard deviation


def motion(times, bare, change):
    """(called for, evidence) of translation, rotation and scaling, which pictures show together."""
    together = (
        "; which of translation, rotation and scaling it is, one camera at a time cannot tell"
    )
    if len(set(times)) == 1:
        verdict = False, f"all {len(times)} views have the time {times[0]:g}, so nothing can move"
    elif bare is None:
        verdict = (
            True,
            f"kept: {len(times)} views without a silhouette cannot show whether something moves",
        )
    elif bare > BARE:
        verdict = (
            True,
            f"{100 * bare:.1f} % of the foreground is nowhere that all other times allow{together}",
        )
    elif change is None or change > COLOR_CHANGE:
        shown = (
            "no point is seen often enough"
            if change is None
            else f"colours of one point differ by {change:.3f}"
        )
        verdict = (
            True,
            f"kept: silhouettes agree over time, but {shown}, which motion inside them would explain",
        )
    else:
        verdict = (
            False,
            (
                f"one still shape fits all silhouettes ({100 * bare:.2f} % of the foreground left over) "
                f"and colours of one point differ by {change:.3f} only"
            ),
        )
    return dict.fromkeys(fx.MOTION, verdict)


def view_color(bare, change):
    """(called for, evidence) of a colour that depends on the viewer."""
    if bare is not None and bare > BARE:
        return True, (
            f"kept: {100 * bare:.1f} % of the foreground changes, and of what moves no two cameras show the "
            f"same moment"
        )
    if change is None:
        return (
            True,
            f"kept: no surface point is seen by {WITNESSES} views, so none can be compared between cameras",
        )
    if change > COLOR_CHANGE:
        return True, f"the colour of one still point differs by {change:.3f} between cameras"
    return (
        False,
        f"the colour of one point differs by {change:.3f} between cameras, no more than sampling makes it",
    )


def view_geometry(times, bare):
    """(called for, evidence) of shapes that depend on the viewer."""
    if bare is None:
        return True, "kept: without two silhouettes, 0 shapes can be compared between cameras"
    if bare > BARE:
        if len(set(times)) == 1:
            return (
                True,
                f"{100 * bare:.1f} % of the foreground is nowhere that all other cameras allow, at one time",
            )
        return True, (
            f"kept: {100 * bare:.1f} % of the foreground changes, and motion and the viewer cannot be told "
            f"apart where every camera has its own time"
        )
    return (
        False,
        f"one shape fits the silhouettes of all cameras ({100 * bare:.2f} % of the foreground left over)",
    )


def background(views, masks, color):
    """(called for, evidence) of a colour behind the scene."""
    share = 1 - float(np.mean([mask.mean() for mask in masks]))
    if share == 0:
        return False, "0 % of the pixels show the background"
    if not np.any(color):
        return (
            False,
            f"{100 * share:.0f} % of the pixels show the background, and it is black, which needs no term",
        )
    return True, f"{100 * share:.0f} % of the pixels show a background that is not black"
