"""Which effects do the pictures call for? Inferred from images, cameras and times alone.

Silhouettes decide about motion. If nothing moves and nothing depends on the viewer, every pixel of
the foreground looks at some point that is foreground in all other views too. These points form the
visual hull (Laurentini 1994). Foreground that the hull does not cover proves that something
changed. Where nothing contradicts, the colours that the views show of one point of the hull's
surface decide about a dependence on the viewer. Where pictures cannot tell, an effect is kept: a
model with an effect too many is larger, a model with an effect too few is wrong.
"""

from itertools import product

import numpy as np
from scipy.ndimage import binary_dilation

from .. import effects as fx
from ..scenes.scene import MODEL_EFFECTS

GRID = 72  # points of the hull along an axis
BARE = 0.002  # share of the foreground that the lattice may leave bare at thin parts
COLOR_CHANGE = 0.05  # of 1: the change of one point's colours by texture and by a too large hull
QUANTILE = (
    0.75  # of the points: a quarter may lie in concavities, where the hull is not the surface
)
WITNESSES = 6  # views that must see a point before its colours are compared
POINTS = 600  # surface points whose colours are compared
AROUND = np.ones((3, 3), bool)
KEPT = "kept: "


def suggest(scene):
    """The effects that a scene's training views call for; its list of effects is not read.

    Returns [{effect, called_for, evidence}] for the closed list in its order. The evidence is one
    sentence with a number.
    """
    views = scene.train
    times = np.array([view.time for view in views])
    masks = [foreground(view, scene.background) for view in views]
    bare, change = evidence_of_change(views, masks)
    occlusion = f"{KEPT}{len(views)} pictures cannot exclude that one surface hides another"
    found = {
        **dict.fromkeys(fx.MOTION, motion(times, bare, change)),
        "view_color": view_color(bare, change),
        "view_geometry": view_geometry(times, bare),
        "occlusion": (True, occlusion),
        "background": background(masks, scene.background),
    }
    return [
        {"effect": effect, "called_for": found[effect][0], "evidence": found[effect][1]}
        for effect in MODEL_EFFECTS
    ]


def foreground(view, color):
    """Where a view shows more than its background, (H, W) bool: by its alpha or by its colour."""
    if view.alpha is not None:
        return view.alpha > 0.5
    return np.abs(view.image - color).max(axis=2) > 0.02


def evidence_of_change(views, masks):
    """The share of the foreground that the hull leaves bare, and the change of a point's colour.

    None for what is unknown.
    """
    total = sum(int(mask.sum()) for mask in masks)
    if len(views) < 2 or all(mask.all() for mask in masks) or not total:
        return None, None
    hull, step = visual_hull(views, masks)
    depths = [depth_map(hull, step, view.camera) for view in views]
    bare = sum(int((mask & np.isinf(depth)).sum()) for mask, depth in zip(masks, depths)) / total
    return bare, color_change(views, masks, hull, step, depths)


def visual_hull(views, masks):
    """Points (M, 3) of a lattice that no view shows as background, and the lattice's step.

    A view that does not see a point says nothing about it.
    """
    middle, reach = looked_at(views)
    line = np.linspace(-reach, reach, GRID)
    points = middle + np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    for view, mask in zip(views, masks):
        row, column, depth, inside = pixels_of(points, view.camera)
        keep = ~inside
        keep[inside] = mask[row[inside], column[inside]]
        points = points[keep & (depth > 0)]
    return points, 2 * reach / (GRID - 1)


def looked_at(views):
    """The point nearest to all optical axes, and the radius around it that a typical view shows."""
    cameras = [view.camera for view in views]
    axes = np.array([camera.R[2] for camera in cameras])
    centers = np.array([camera.center for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    sums = across.sum(axis=0), np.einsum("nij,nj->i", across, centers)
    middle = np.linalg.lstsq(*sums, rcond=None)[0]
    opening = [max(c.width / c.f_x, c.height / c.f_y) / 2 for c in cameras]
    return middle, float(np.median(np.linalg.norm(centers - middle, axis=1) * opening))


def pixels_of(points, camera):
    """Row, column and depth of points, and whether they are in the picture."""
    x, y, z = (points @ camera.R.T + camera.T).T
    near = np.where(z > 1e-6, z, np.inf)
    column = np.rint(camera.f_x * x / near + camera.c_x).astype(np.int64)
    row = np.rint(camera.f_y * y / near + camera.c_y).astype(np.int64)
    inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    return row, column, z, inside & (z > 1e-6)


def depth_map(hull, step, camera):
    """Depth of the hull's nearest point in or beside every pixel, infinite where there is none."""
    row, column, z, inside = pixels_of(hull, camera)
    height, width = camera.height, camera.width
    depth = np.full((height + 2, width + 2), np.inf)
    reach = int(np.ceil(step * max(camera.f_x, camera.f_y) / np.median(z) / 2)) if len(z) else 1
    for dv, du in product(range(-reach, reach + 1), repeat=2):
        v = np.clip(row[inside] + 1 + dv, 0, height + 1)
        u = np.clip(column[inside] + 1 + du, 0, width + 1)
        np.minimum.at(depth, (v, u), z[inside])
    return depth[1:-1, 1:-1]


def color_change(views, masks, hull, step, depths):
    """How much the colour of one surface point differs between the views that see it.

    It is a quantile over the points of their standard deviation. A view sees a point if no point of
    the hull lies before it and its pixel is well inside the foreground.
    """
    shown = np.full((len(views), len(hull), 3), np.nan)
    for color, view, depth, mask in zip(shown, views, depths, masks):
        inner = ~binary_dilation(~mask, AROUND)
        row, column, z, inside = pixels_of(hull, view.camera)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        seen = inside & inner[row, column] & (z <= depth[row, column] + step)
        color[seen] = view.image[row[seen], column[seen]]
    often = np.flatnonzero(np.isfinite(shown[:, :, 0]).sum(axis=0) >= WITNESSES)
    if not len(often):
        return None
    chosen = shown[:, often[np.linspace(0, len(often) - 1, min(POINTS, len(often))).astype(int)]]
    # Medians, because a view that looks past the body must not count.
    middle = np.nanmedian(chosen, axis=0)
    spread = np.nanmedian(np.abs(chosen - middle), axis=0).max(axis=1)
    return float(np.quantile(1.4826 * spread, QUANTILE))  # a normal distribution's deviation


# --- verdicts: (called for, evidence) ------------------------------------------------------------
def motion(times, bare, change):
    """Translation, rotation and scaling, which pictures show together."""
    if len(set(times)) == 1:
        return False, f"all {len(times)} views have the time {times[0]:g}, so nothing can move"
    if bare is None:
        return (
            True,
            f"{KEPT}{len(times)} views without silhouettes cannot show whether anything moves",
        )
    if bare > BARE:
        return True, (
            f"{100 * bare:.1f} % of the foreground is where some other time shows background; one "
            "camera at a time cannot tell translation, rotation and scaling apart"
        )
    if change is None or change > COLOR_CHANGE:
        unseen = f"no point is seen by {WITNESSES} views"
        shown = unseen if change is None else f"colours of one point differ by {change:.3f}"
        return True, f"{KEPT}silhouettes agree over time, but {shown}, as with motion inside them"
    return False, (
        f"one still shape fits all silhouettes ({100 * bare:.2f} % of the foreground left over), "
        f"and colours of one point differ only by {change:.3f}"
    )


def view_color(bare, change):
    """A colour that depends on the viewer."""
    if bare is not None and bare > BARE:
        return True, (
            f"{KEPT}{100 * bare:.1f} % of the foreground changes, and no two cameras show what "
            "moves at the same moment"
        )
    if change is None:
        return True, f"{KEPT}no surface point is seen by {WITNESSES} views, so none can be compared"
    if change > COLOR_CHANGE:
        return True, f"the colour of one still point differs by {change:.3f} between cameras"
    return False, (
        f"the colour of one point differs by {change:.3f} between cameras, not more than sampling "
        "explains"
    )


def view_geometry(times, bare):
    """Shapes that depend on the viewer."""
    if bare is None:
        return True, f"{KEPT}without two silhouettes, 0 shapes can be compared between cameras"
    share = f"{100 * bare:.1f} % of the foreground"
    if bare > BARE and len(set(times)) == 1:
        return True, f"{share} is where some other camera shows background, at one time"
    if bare > BARE:
        return True, (
            f"{KEPT}{share} changes, and where every camera has its own time, motion and viewer "
            "cannot be told apart"
        )
    return False, f"one shape fits the silhouettes of all cameras ({100 * bare:.2f} % left over)"


def background(masks, color):
    """A colour behind the scene."""
    share = 1 - float(np.mean([mask.mean() for mask in masks]))
    shown = f"{100 * share:.0f} % of the pixels show"
    if share == 0:
        return False, f"{shown} the background"
    if not np.any(color):
        return False, f"{shown} the background, and it is black, which needs no term"
    return True, f"{shown} a background that is not black"
