# %% [markdown]
# # Beyond the paper: a file without context (rejected)
#
# This is the record of a decision, not a lesson with exercises. It says what was expected, what was
# measured, and why nothing was built. It runs in a few seconds on a model of `tiny_coded`, scene
# `bouncing`, seed 0. Name another file of coded networks to look at that one instead:
#
#     python tutorials/beyond_context.py report/bouncing.p4dgs
#
# **Files:** [hash_grid.py](../p4dgs_ref/lab/accuracy/hash_grid.py) (the study whose functions
# are used here), [beyond_networks.py](beyond_networks.py) (coded networks, B1).

# %%
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from p4dgs_ref import decode
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.lab.accuracy.hash_grid import COMMON, ContextFit, pays_from, without_context, written
from p4dgs_ref.lab.accuracy.quantisation import fixed
from p4dgs_ref.lab.school import lessons
from p4dgs_ref.model import Anchors
from p4dgs_ref.report.inspect import components

plt = lessons.pyplot()
named = [name for name in sys.argv[1:] if name.endswith(".p4dgs")]
path = Path(named[0] if named else Path(__file__).with_name("beyond_context.p4dgs"))
data = path.read_bytes()
model, sizes = decode(data), components(data)

# %% [markdown]
# ## Hypothesis
# The hash grid and two networks, $\psi_p$ and $\psi_q$, predict the distribution of every attribute
# (Eqs. 8, 9 and 12). The decoder needs them, so the file holds them. With few anchors they cost
# more than they save. As float16 they take 4,112 bytes and pay from about 2,900 anchors on
# (`p4dgs-ref accuracy --only hash_grid`); our scenes have 200.
#
# Without them a file would hold one mean, one deviation and one step for each of the 34 channels of
# an anchor. A rate-adaptive encoder could choose the smaller form. We expected this choice to
# matter at our size. But coded networks change the account: their context takes few bytes, and the
# number of anchors from which it pays should fall in proportion.

# %% [markdown]
# ## What the context saves in this file
# The functions of the study write the attributes of this model again: once with the trained
# context, and once with one Gaussian per channel. Steps and symbols are the same in both.

# %%
# The same anchors in the paper's design: float16 networks, positions of 16 bits.
plain = replace(model, design=model.design._replace(coded=False, position_bits=16), steps=None)


def with_context(model):
    """Bytes of the attributes, and of grid and float16 networks, with the model's own context."""
    found = written(model, model.design, model.networks, model.grids)
    return found["attribute_bytes"], found["grid_bytes"] + found["mlp_bytes"]


moments = 4 * sum(model.design.widths)  # means and deviations as float16
trained, context_bytes = with_context(plain)
alone = without_context(plain, quantise(plain))["attribute_bytes"]
saved = alone - trained
costs = {
    "float16 networks": context_bytes - moments,
    "coded networks": sizes["context_mlps"] + sizes["hash_grid"] - moments,
}
print(f"{path.name}: {len(data):,} bytes, {model.primitives} anchors")
print(f"attributes: {trained:,} bytes with context, {alone:,} with one Gaussian per channel")
print(f"grid {sizes['hash_grid']} bytes, coded context networks {sizes['context_mlps']}")
for name, cost in costs.items():
    print(f"{name}: the context saves {saved} bytes and costs {cost:,}: {saved - cost:+,} bytes")

# %% [markdown]
# ## From how many anchors on the context pays
# Now a new context learns the attributes of some of the anchors, drawn at random, all with the
# steps $Q_0$. Beyond the anchors of the file, the saving per anchor is taken to stay the same. The
# cost of coded networks is that of the file. It would grow with the anchors, but only where this
# saves more than it costs.


# %%
def some(model, A):
    """The model with A of its anchors, all steps Q_0."""
    chosen = np.sort(np.random.default_rng(A).permutation(model.primitives)[:A])
    return fixed(replace(model, anchors=Anchors(*(a[chosen] for a in model.anchors))))


def saved_by_new_context(A, steps=300):
    """Bytes of the attributes of A anchors that a newly trained context saves."""
    part = some(plain, A)
    q = quantise(part)
    fit = ContextFit(part, q, *COMMON)
    for _ in range(steps):
        fit.step()
    stored = written(part, fit.design, fit.networks, fit.p.listed("grid"))
    return without_context(part, q)["attribute_bytes"] - stored["attribute_bytes"]


most = model.primitives
measured = {A: saved_by_new_context(A) for A in (most // 2, 3 * most // 4, most)}
print("saved by a new context:", ", ".join(f"{n} of {A} anchors" for A, n in measured.items()))


def break_even(cost, measured):
    """The anchors from which the context pays, by the rule of the study."""
    return pays_from(
        [
            {"anchors": A, "saved_bytes": n, "cost_bytes": cost, "net_bytes": n - cost}
            for A, n in measured.items()
        ]
    )


for name, cost in costs.items():
    ends = break_even(cost, measured), break_even(cost, {most: saved})
    print(f"{name}: pays from {ends[0]:,.0f} anchors (new context), {ends[1]:,.0f} (the file's)")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
anchors = np.array([60, 6000])
left.loglog(list(measured), list(measured.values()), "o", label="saved by a new context")
left.loglog(most, saved, "s", label="by the file's context")
for at, n in enumerate((measured[most], saved)):
    left.loglog(anchors, n * anchors / most, ":", color=lessons.COLORS[at])
for (name, cost), style in zip(costs.items(), ("-", "--")):
    left.axhline(cost, color="black", ls=style, label=f"cost: {name}")
lessons.finish(
    left,
    xlabel="anchors",
    ylabel="bytes",
    title="from where the context pays",
    ylim=(50, 20_000),
    legend={"fontsize": 10},
)
forms = {"one Gaussian\nper channel": (alone, moments)}
for name, cost in costs.items():
    forms[f"context,\n{name.split()[0]}"] = trained, cost + moments
for form, (attributes, rest) in forms.items():
    right.bar(form, attributes, color=lessons.COLORS[0])
    right.bar(form, rest, bottom=attributes, color=lessons.COLORS[1])
    right.text(form, attributes + rest, f"{attributes + rest:,}", ha="center", va="bottom")
right.set(
    ylabel="bytes",
    title="attributes and prediction",
    ylim=(0, 10_500),
)
right.legend(["attributes", "grid and networks, or moments"], fontsize=10)
lessons.show(figure, "beyond_context")

# %% [markdown]
# ## Decision
# **Not built.** The format keeps its one form, with context.
#
# - **Bytes.** Before coded networks a mode without context would have saved 3.9 kB of 38.7, ten
#   percent. With them it saves 228 of this file's 9,026 bytes, 2.5 %.
# - **PSNR.** Trainings with one mean, deviation and step per channel (an experiment before B1 was
#   finished, with networks coded at a similar rate) saved 255 bytes, also 2.5 %, and lost 0.14 dB.
#   Two trainings of one scene differ by as much, so there is no gain to speak of.
# - **Break-even.** With float16 networks the context of this file pays from thousands of anchors
#   on, the study says 2,900. With coded networks both measurements divide by ten: 230 anchors for
#   a context that is trained alone, 450 for the one in the file, which is trained with everything
#   else and for its own bits too. The paper's scenes have tens of thousands.
# - **Time.** The context takes about 6 % of the time in which this file is decoded.
# - **Price of building it.** A second meaning of sections in the format, a flag, a second path in
#   training and in every port.
#
# The rate does what the mode would have done. The bits of $\psi_p$ and $\psi_q$ are in the loss, so
# training keeps only as much of the context as pays: 434 instead of 4,112 bytes in this file.
#
# What these figures leave out: the file's context also chooses a step for every anchor (Eq. 8),
# and the table counts this at nothing. Random subsets of anchors are farther apart than trained
# ones, so that a context finds less in them than in models with so few anchors. One scene, one
# seed.
