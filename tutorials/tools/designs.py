"""The table at the end of `00_whole_paper`: five designs of its scene, trained alike.

    python -m tutorials.tools.designs

prints it, the mean and the range of seeds 0, 1 and 2 (about five minutes of one core). Free
Gaussians are trained here with Eq. (16) for as many steps as anchors, so that all rows have the
same loss; in the tutorial itself they have the mean squared error.
"""

import types
from functools import partial

import numpy as np

from . import shared

PATH = shared.FOLDER / "00_whole_paper.py"


def whole_paper(source):
    """Return the tutorial as a module, without running its training."""
    module = types.ModuleType("whole_paper")
    module.__file__ = str(PATH)
    exec(compile(source, str(PATH), "exec"), vars(module))
    return module


def designs(whole, seed):
    """Yield (name, dB, bytes without networks, Gaussians, bytes of networks) of each design."""
    sizes = {name: 2 * sum(map(np.prod, whole.NETWORKS[name])) for name in whole.NETWORKS}
    of_motion, of_all = sizes["psi_d"], sum(sizes.values())
    of_context = sizes["psi_p"] + sizes["psi_q"]
    children = whole.A * whole.k

    def free_loss(p, shot):
        gaussians, back_free = whole.free(p, shot[2])
        L_render, back_render = whole.render_loss(gaussians, shot)
        return L_render, {}, lambda: back_free(*back_render())

    def draw_free(p, R, T, t):
        return whole.render(*whole.free(p, t)[0], R, T)[0].clip(0, 1)

    def quality(p, values):
        return whole.psnr(partial(whole.draw, p, values), whole.unseen)

    for N in (children, 80):  # as many as there are children, and 80, which draw as well
        rng = np.random.default_rng(seed)
        p = whole.free_start(N, rng) | whole.random_weights(["psi_d"], rng)
        steps = whole.STAGE_ENDS[-1]
        whole.fit(p, whole.Adam(steps), free_loss, whole.views, steps, rng)
        dB = whole.psnr(partial(draw_free, p), whole.unseen)
        yield f"{N} free Gaussians and psi_d", dB, 28 * N, N, of_motion
    p, _ = whole.train(whole.views, seed, bits=False)
    size = 2 * whole.A * (3 + whole.n)
    dB = quality(p, whole.attributes(p))
    yield "anchors predict the Gaussians", dB, size, children, of_all - of_context
    p, _ = whole.train(whole.views, seed)
    file = whole.encode(p)
    decoded, values = whole.decode(b"".join(file.values()))
    anchor_bits, hash_bits = whole.coded_bits(decoded, values)
    size = 6 * whole.A + (anchor_bits.sum() + hash_bits) / 8
    yield "with noise and rate", quality(p, whole.attributes(p)), size, children, of_all
    size = sum(map(len, file.values())) - of_all
    yield "the file, decoded", quality(decoded, values), size, children, of_all


def table(whole):
    """Return the rows as Markdown: means over seeds, and ranges over seeds."""
    lines = []
    for rows in zip(*(designs(whole, seed) for seed in range(3))):
        (name, *_), (_, dB, size, N, networks) = rows[0], map(np.array, zip(*rows))
        spread = f"{dB.min():.1f} to {dB.max():.1f} | {size.min():,.0f} to {size.max():,.0f}"
        sizes = f"{(size / N).mean():.1f} | {(size + networks).mean():,.0f}"
        lines.append(f"| {name} | {dB.mean():.1f} | {spread} | {sizes} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(whole_paper(PATH.read_text(encoding="utf-8"))))
