"""The animation of the README: the truth beside the decoded picture beside its error, over time.

The ray tracer draws the truth from the scene's own description, with the camera and the time of the
decoded picture. The camera swings slowly, at times that no training view has, and the animation
plays forwards and backwards. Truth and decoded picture are drawn ENLARGED times as large as the
training views.
"""

import numpy as np

from p4dgs_ref.report import evaluate, figures
from p4dgs_ref.scenes import load, scene, simulator
from p4dgs_ref.scenes.files import write_image
from p4dgs_ref.scenes.simulator.trace import trace
from tutorials.tools import show
from tutorials.tools.shared import in_few_colors

FRAMES = 16
MILLISECONDS = 110  # a frame
AZIMUTHS = (0, 60)  # degrees, of the first and the last frame
ELEVATION = 35  # degrees
ENLARGED = 4  # times the sides of a training view
GAP = 12  # pixels between panels and around them
HEAD = 34  # pixels for the titles
FOOT = 46  # pixels for the scale of the error
ERROR = {"cmap": "magma", "vmin": 0, "vmax": figures.ERROR_RANGE}  # its colours


# --- pictures -------------------------------------------------------------------------------------
def views(description):
    """The (camera, time) of every frame."""
    path = np.radians(np.linspace(*AZIMUTHS, FRAMES))
    return [
        (simulator.camera_at(description, azimuth, np.radians(ELEVATION)), (i + 0.5) / FRAMES)
        for i, azimuth in enumerate(path)
    ]


def truth(description, camera, t, background):
    """The picture [H, W, 3] that the ray tracer draws, in the 8 bits that a scene's files have."""
    pixels = np.rint(trace(description, camera, t) * 255).astype(np.uint8)
    return scene.over_background(pixels / 255, background)[0]


# --- frames ---------------------------------------------------------------------------------------
@figures.figure_style()
def frame(true, picture, t):
    """One frame [height, width, 3] in 8 bits: three panels with titles, the scale of the error."""
    error = np.abs(picture - true).mean(axis=2)
    panels = (
        (f"truth, t = {t:.2f}", true),
        (f"decoded, PSNR {evaluate.psnr(picture, true):.1f} dB", picture),
        (f"error from 0 to {figures.ERROR_RANGE}, mean {error.mean():.3f}", error),
    )
    side = true.shape[1]
    width, height = 3 * side + 4 * GAP, HEAD + true.shape[0] + FOOT
    figure = figures.new_figure(figsize=(width / 100, height / 100), dpi=100)

    def write(text, x, y, align):
        figure.text(x / width, y / height, text, ha=align, va="center", fontsize=11)

    for i, (title, pixels) in enumerate(panels):
        left = GAP + i * (side + GAP)
        figure.figimage(pixels, left, FOOT, **ERROR, origin="upper")
        write(title, left + side / 2, height - HEAD / 2, "center")
    figure.figimage(
        np.tile(np.linspace(0, figures.ERROR_RANGE, side // 2), (12, 1)),
        left + side // 4,
        FOOT // 2 - 6,
        **ERROR,
    )
    write("0 ", left + side // 4, FOOT / 2, "right")
    write(f" ≥ {figures.ERROR_RANGE}", left + 3 * side // 4, FOOT / 2, "left")
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]


def write_animation(path, model, name="bouncing"):
    """Write the animation of a decoded model of a packaged scene to a GIF."""
    description = simulator.read_description(load.find_scene(name) / load.DESCRIPTION)
    shown = [
        (
            truth(description, show.enlarged(camera, ENLARGED), t, model.background),
            show.frame(model, camera, t, ENLARGED),
            t,
        )
        for camera, t in views(description)
    ]
    frames = in_few_colors(np.array([frame(*one) for one in shown]))
    write_image(path, [*frames, *frames[-2:0:-1]], duration=MILLISECONDS, loop=0)
