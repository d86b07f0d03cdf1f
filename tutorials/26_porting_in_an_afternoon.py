# %% [markdown]
# # Porting in an afternoon, and what the checker says
#
# **Promise.** After this you can port the method to another language in six steps, and read from
# the checker's first line which of your lines is wrong. **Before it:** `07_noise_and_rounding`,
# `09_hash_grid`, `15_compositing`, `21_intervals_to_rans`. **Takes** ten seconds on two cores,
# 15 minutes of reading and 15 of exercises.
#
# **Files:** [p4dgs.js](../p4dgs_ref/viewer/p4dgs.js),
# [adapter.js](../p4dgs_ref/viewer/adapter.js), [adapter.py](../p4dgs_ref/oracle/adapter.py).

# %%
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show(
    "26_porting_in_an_afternoon",
    "rounding",
    "hash_grid",
    "projection",
    "compositing",
    "entropy_coder",
    "file",
)
node = shutil.which("node") or print("node is not installed: the port is not run here")

# %% [markdown]
# ## What fails without it
# A port is finished, and the trained scene appears on the screen. Is it right? Two mistakes that
# porters make leave a picture that looks right: quaternions in the order (x, y, z, w), and pixels
# with their centres at one half. On the ten test views they cost 4.4 and 8.6 dB, and no picture
# says which line to look at. With the first mistake, anchor 29's splats (purple) are where they
# should be, and only point in another direction.

# %%
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import FAST
from p4dgs_ref.training.objective import psnr

model, views = tour.MODEL, load_scene("bouncing").test
ORDER = {"quaternions (x, y, z, w)": [3, 0, 1, 2]}
SHIFT = {"pixel centres at ½": -0.5}


def ported(mistake, view):
    """The Gaussians and the camera of a view, as a port with this mistake reads them."""
    g, shift = model.gaussians(view.time, view.camera), SHIFT.get(mistake, 0)
    camera = replace(view.camera, c_x=view.camera.c_x + shift, c_y=view.camera.c_y + shift)
    return g._replace(r=g.r[:, ORDER.get(mistake, [0, 1, 2, 3])]), camera


def drawn(mistake, view):
    g, camera = ported(mistake, view)
    return render.forward(*g[:5], camera, model.background, FAST, True)[0][0]


names = ("right", *ORDER, *SHIFT)
reached = {name: np.mean([psnr(drawn(name, v), v.image) for v in views]) for name in names}
for name, decibels in reached.items():
    print(f"{name}: {decibels:.2f} dB")
assert [round(float(decibels), 1) for decibels in reached.values()] == [33.5, 29.1, 24.9]

# %%
figure, axes = plt.subplots(1, 3, figsize=(13, 4.6), layout="constrained")
for ax, name in zip(axes, names):
    g, camera = ported(name, views[1])
    ax.imshow(np.clip(drawn(name, views[1]), 0, 1))
    own = g.index // model.design.k == figures.THREAD.index
    show.ellipses(ax, *show.splats(g, camera, own)[:2], fc="none", ec=figures.THREAD.color, lw=2)
    ax.set(title=f"{name}: {reached[name]:.1f} dB", xticks=(), yticks=())
figures.show(figure, "26_porting_pictures")

# %% [markdown]
# ## Claim
# The project has a port of its own, in JavaScript: a file is decoded and drawn in a browser. It
# was written from two pages, the one of the file format (`python -m p4dgs_ref.codec` prints it)
# and the one of the [golden vectors](../p4dgs_ref/oracle/v1/README.md). We follow the six steps of
# the second page, make the mistakes that porters make, and see what the checker says of them. The
# claim is that a mistake in one line shows as one equation, not as a picture that looks strange.
# For example, Eq. (10) rounds a feature to a multiple of its step, ties to even:
# $$\hat f = \lfloor f/q \rceil\, q \tag{10}$$
# The function of JavaScript that is called `Math.round` rounds ties *up*.

# %% [markdown]
# ## By hand
# The symbols of $f/q = 0.5, 1.5, 2.5$ are $0, 2, 2$. `Math.round` computes $\lfloor v +
# \frac12\rfloor$ and gives $1, 2, 3$. A decoder never divides by $q$, but it rounds the weights of
# the networks of Eqs. (8) and (12) to integers in the same way. So one tie among these weights is
# enough to spoil a file.

# %%
assert [(round(v), (v + 0.5) // 1) for v in (0.5, 1.5, 2.5)] == [(0, 1), (2, 2), (2, 3)]

# %% [markdown]
# ## In code
# **Steps 1 and 2: copy the folder, read the manifest.** `p4dgs-ref oracle export vectors` writes
# it. A port that runs as a process needs neither: the checker sends it every case as one line of
# JSON, and the port answers with one line. That is what `adapter.js` does, in 300 lines of which
# most name an equation and the shape of its output.
#
# **Step 3: level L0**, scalar functions such as the hash of a grid's node or the rounding of ties.
# **Step 4: level L1**, one equation after the other, in the order in which data flow. **Step 6:
# levels L2 to L4**, stages, compressed files and whole pictures. Step 5, the gradients, comes
# below. The whole check is one command and takes five seconds:
#
#     p4dgs-ref oracle check --adapter "node p4dgs_ref/viewer/adapter.js"
#
# The function below does the same for a copy of the port in which one piece of code is replaced by
# another. Without a mistake, all cases pass.


# %%
import p4dgs_ref as p4
from p4dgs_ref.oracle.adapter import Adapter
from p4dgs_ref.oracle.checker import check_port

viewer = Path(p4.__file__).parent / "viewer"
source = (viewer / "p4dgs.js").read_text(encoding="utf-8")


def checked(right, wrong, only):
    """The report on the port with one piece of its code replaced by another."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(viewer / "adapter.js", folder)
        Path(folder, "p4dgs.js").write_text(source.replace(right, wrong), encoding="utf-8")
        with Adapter(f"node {folder}/adapter.js", timeout=60) as port:
            return check_port(port, only=only.split())


assert not node or checked("", "", "rounding hash_grid covariance compositing").ok

# %% [markdown]
# ## Gradients
# **Step 5: the gradients.** A viewer needs none, and the port has none. It says so in its first
# line, `"gradients": false`, and lists its 30 subjects there. The checker then judges the outputs
# of these alone, and its report names what the port lacks, so that nobody takes it for a trainer.
#
# Outputs alone say nothing about a backward. Eq. (1), $x = x_a + O_a\,l_a$, has the gradient
# $\bar x_a = \sum_k \bar x$. A port that forgets that one anchor moves all its $k$ children, and
# takes their mean instead, has right pictures and trains wrongly. Only `in_bar.x_a` shows it.

# %%
lessons.check_mistake(
    lambda x_a, O_a, l_a: x_a[:, None] + O_a * l_a[:, None],
    "offsets",
    vjp=lambda inputs, bars: {
        "x_a": bars["x_bar"].mean(axis=1),
        "O_a": bars["x_bar"] * inputs["l_a"][:, None],
        "l_a": (bars["x_bar"] * inputs["O_a"]).sum(axis=1),
    },
)

# %% [markdown]
# ## Break it
# Here are seven mistakes. Each replaces one expression of the port. `MISTAKES` also says which
# subjects are run, which case must fail first, and how many of their cases fail. The last mistake
# was really made, when the code was shortened. The reach of a splat that nothing cuts off is
# infinite. If the splat is also infinitely wide, its conic is 0, and infinity times zero is NaN. No
# picture of a trained model shows this; the case `equal_depths` and nine others do.

# %%
MISTAKES = {
    "ties are rounded up": (
        "up % 2 !== 0 ? up - 1 : up",
        "up % 2 !== 0 ? up : up",
        "rounding",
        "rounding_ties/ordinary",
        8,
    ),
    "the hash multiplies in doubles": (
        "Math.imul(j, 2654435761) ^ Math.imul(k, 805459861)",
        "(j * 2654435761) ^ (k * 805459861)",
        "hash_grid",
        "hash_index/products_beyond_doubles",
        1,
    ),
    "weights are read by columns": (
        "v * W[w]",
        "v * W[j * I + i]",
        "mlp opacity color",
        "mlp/ordinary",
        8,
    ),
    "quaternions are (x, y, z, w)": (
        "rotationMatrix(w, x, y, z)",
        "rotationMatrix(x, y, z, w)",
        "covariance projection_stage",
        "rotation_matrix/ordinary",
        11,
    ),
    "pixels have their centres at ½": (
        "const e_2 = v - v_0",
        "const e_2 = v + 0.5 - v_0",
        "compositing",
        "compositing/ordinary",
        18,
    ),
    "numbers are shifted in 32 bits": (
        "Math.floor((v + Math.floor(2 ** s / 2)) / 2 ** s)",
        "(v + ((1 << s) >> 1)) >> s",
        "codec",
        "codec/smallest_grid",
        23,
    ),
    "infinity times zero": (
        "const tall = Math.sqrt(reach * variance);",
        "const tall = Math.sqrt((reach * A) / (A * C - B * B));",
        "compositing",
        "compositing/equal_depths",
        10,
    ),
}
for mistake, (right, wrong, only, first, failing) in (MISTAKES if node else {}).items():
    report = checked(right, wrong, only)
    said = str(report).split("first divergence: ")[1].partition("\n\n")[0]
    print(f"{mistake}: {said}\n")
    assert (report.first.id, sum(r.wrong for r in report.results)) == (first, failing)

# %% [markdown]
# Read the first divergence and leave the rest. In the whole check, weights read by columns fail in
# 59 cases, but the first is `mlp`, the only one to mend. The checker knows three of the mistakes by
# name, and explains what the port does. The hash is the opposite: a single case fails, one that was
# made for it, and no picture would ever have shown the mistake.

# %%
figure, ax = plt.subplots(figsize=(9, 4))
ax.barh(list(MISTAKES), [row[-1] for row in MISTAKES.values()], edgecolor="k")
figures.finish(ax, xlabel="cases that fail; the first of them names the equation")
figures.show(figure, "26_porting", title="Seven mistakes in one line each")

# %% [markdown]
# ## What a codec does with it
# The makers of a video codec publish *conformance streams*: files, and what a decoder must find in
# them. Here they are level L3, 69 small files, of which 46 must be refused. A decoder's numbers
# must agree bit for bit, so no tolerance hides anything: a shift in 32 bits spoils all 23 others.
#
# The *reason* that a decoder gives for refusing a file is not judged, and there the port had two
# more mistakes. It read the networks in the order of the sections, whereas the package reads psi_d
# last, so the two named different sections of a file in which two are damaged. And in one refusal
# two arguments were swapped, so that a text stood where the byte should be. All streams passed
# nevertheless. Both mistakes were found by comparing section, byte and kind of the refusals, on the
# streams and on 2,000 damaged files.

# %% [markdown]
# ## What this idea buys
# For each of seven mistakes of one line, the checker's first line names the equation, or the codec,
# within seconds; the whole check takes about five. Two of the seven are those of the pictures
# above, which look right and lose 4.4 and 8.6 dB. The paper published no vectors: whoever ports it
# has its equations and, at best, pictures to compare with.
#
# **In short**
# - Copy the vectors, begin with scalar functions, then equations, then gradients, then the whole.
# - Read the first divergence and leave the rest.
# - What is coded must agree bit for bit; there no tolerance hides anything.
#
# **Often misunderstood**
# - *The picture looks right, so the port is right.* It looks right with quaternions in another
#   order.
# - *Many failing cases are a large mistake.* 59 cases failed because of one expression.
# - *A port without gradients cannot be checked.* It says what it lacks and is judged by the rest.

# %% [markdown]
# ## Exercises
# **26.1** ● How many of the six ties $-2.5, -1.5, \dots, 2.5$ does $\lfloor v + \frac12\rfloor$
# round otherwise than to even? For example, $0.5$ is one of them and $1.5$ is not.
#
# **26.2** ●● A double holds every integer up to $2^{53}$, and beyond it only the even ones. What is
# the smallest $j$ for which the product $2654435761\, j$ of the hash is not exact in a double?
#
# **Predict, then run.** In a file, a level of the hash grid has at most $2^{16}$ nodes along an
# axis. Which files does a port decode wrongly that multiplies in doubles?

# %%
answer_1 = answer_2 = ...
lessons.check_number("26.1", answer_1)
lessons.check_number("26.2", answer_2)

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check --adapter "CMD"` checks a port that runs as a process, and
# `p4dgs-ref oracle check DIR` one that writes files. Start with `--level L0`. A port of a part,
# such as a decoder, names its subjects in its first line and is judged by these. Typical mistakes
# of ports are to test with pictures instead of numbers, and to begin with the last level.

# %%
lessons.passes("rounding")
