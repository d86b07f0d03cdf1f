"""The animation of the README: the truth beside the decoded picture beside its error, over time.

The ray tracer draws the truth from the scene's own description, with the camera and the time of the
decoded picture. The camera swings slowly, at times that no training view has, and the animation
plays forwards and backwards. Truth and decoded picture are drawn ENLARGED times as large as the
training views.
"""

from dataclasses import replace

import numpy as np
from matplotlib import colormaps
from scipy.cluster.vq import kmeans2, vq

from p4dgs_ref.report import evaluate, figures
from p4dgs_ref.scenes import load, scene, simulator
from p4dgs_ref.scenes.files import write_image
from p4dgs_ref.scenes.simulator.trace import trace
from p4dgs_ref.splatting.settings import FAST

FRAMES = 22
MILLISECONDS = 80  # a frame
AZIMUTHS = (0, 60)  # degrees, of the first and the last frame
ELEVATION = 35  # degrees
ENLARGED = 4  # times the sides of a training view
GAP = 12  # pixels between panels and around them
HEAD = 34  # pixels for the titles
FOOT = 46  # pixels for the scale of the error
# A GIF has 256 colours in a frame. The error and the letters need theirs exactly.
PICTURE_COLORS, ERROR_COLORS = 192, 32
SAMPLED = 23  # one in so many pixels of the pictures chooses these colours


# --- pictures -------------------------------------------------------------------------------------
def views(description):
    """The (camera, time) of every frame."""
    path = np.radians(np.linspace(*AZIMUTHS, FRAMES))
    return [
        (
            enlarged(simulator.camera_at(description, azimuth, np.radians(ELEVATION))),
            (i + 0.5) / FRAMES,
        )
        for i, azimuth in enumerate(path)
    ]


def enlarged(camera):
    """The camera with ENLARGED times as many pixels along each side, which see the same."""
    return replace(
        camera,
        f_x=ENLARGED * camera.f_x,
        f_y=ENLARGED * camera.f_y,
        c_x=ENLARGED * (camera.c_x + 0.5) - 0.5,
        c_y=ENLARGED * (camera.c_y + 0.5) - 0.5,
        width=ENLARGED * camera.width,
        height=ENLARGED * camera.height,
    )


def truth(description, camera, t, background):
    """The picture [H, W, 3] that the ray tracer draws, in the 8 bits that a scene's files have."""
    pixels = np.rint(trace(description, camera, t) * 255).astype(np.uint8)
    return scene.over_background(pixels / 255, background)[0]


def decoded(model, camera, t):
    """The picture [H, W, 3] of a model, whose splats are blurred as much as in training.

    The renderer's blur is one in pixels, so that without this the splats would be drawn thinner.
    """
    settings = FAST._replace(blur=FAST.blur * ENLARGED**2)
    return np.clip(model.render(camera, t, settings), 0, 1)


def palette(pictures, background):
    """The background and PICTURE_COLORS colours [M, 3] that stand for those of all pictures."""
    sampled = np.concatenate(pictures).reshape(-1, 3)[::SAMPLED]
    colors = np.unique(np.rint(sampled * 255), axis=0)
    centres = kmeans2(colors, PICTURE_COLORS, minit="++", seed=0)[0]
    return np.concatenate([[background], np.rint(centres) / 255])


def with_palette(picture, colors):
    """The picture with the nearest colour of the palette in each pixel."""
    return colors[vq(picture.reshape(-1, 3), colors)[0]].reshape(picture.shape)


# --- frames ---------------------------------------------------------------------------------------
@figures.styled()
def frame(true, picture, t, colors):
    """One frame [height, width, 3] in 8 bits: three panels with titles, the scale of the error."""
    error = np.abs(picture - true).mean(axis=2)
    quality = evaluate.psnr(picture, true)
    panels = (
        (f"truth, t = {t:.2f}", with_palette(true, colors)),
        (f"decoded, PSNR {quality:.1f} dB", with_palette(picture, colors)),
        (f"error from 0 to {figures.ERROR_RANGE}, mean {error.mean():.3f}", error_colors(error)),
    )
    side = true.shape[1]
    width, height = 3 * side + 4 * GAP, HEAD + true.shape[0] + FOOT
    figure = figures.new_figure(figsize=(width / 100, height / 100), dpi=100)

    def write(text, x, y, align):
        figure.text(x / width, y / height, text, ha=align, va="center", fontsize=11)

    for i, (title, pixels) in enumerate(panels):
        left = GAP + i * (side + GAP)
        figure.figimage(pixels, left, FOOT, origin="upper")
        write(title, left + side / 2, height - HEAD / 2, "center")
    ramp = error_colors(np.tile(np.linspace(0, figures.ERROR_RANGE, side // 2), (12, 1)))
    figure.figimage(ramp, left + side // 4, FOOT // 2 - 6, origin="upper")
    write("0 ", left + side // 4, FOOT / 2, "right")
    write(f" ≥ {figures.ERROR_RANGE}", left + 3 * side // 4, FOOT / 2, "left")
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
    grey = (pixels == pixels[..., :1]).all(axis=2)  # letters: 16 greys leave colours for the rest
    pixels[grey] = np.rint(pixels[grey] / 17) * 17
    return pixels


def error_colors(error):
    """The colours of errors [H, W] from 0 to figures.ERROR_RANGE, in ERROR_COLORS steps."""
    return colormaps["magma"].resampled(ERROR_COLORS)(error / figures.ERROR_RANGE)[..., :3]


def write_animation(path, model, name="bouncing"):
    """Write the animation of a decoded model of a packaged scene to a GIF."""
    description = simulator.read_description(load.find_scene(name) / load.DESCRIPTION)
    shown = [
        (truth(description, camera, t, model.background), decoded(model, camera, t), t)
        for camera, t in views(description)
    ]
    pictures = [picture for *pair, _ in shown for picture in pair]
    colors = palette(pictures, model.background)
    frames = [frame(*one, colors) for one in shown]
    write_image(path, frames + frames[-2:0:-1], duration=MILLISECONDS, loop=0)
