# %% [markdown]
# # Beyond the paper: a file without context (rejected)
#
# This is the record of a decision, not a lesson with exercises. It says what was expected, what was
# measured, and why nothing was built. It runs in a few seconds on a model of `tiny_coded`, scene
# `bouncing`, seed 0. Name another file of coded networks to look at that one instead:
#
#     python tutorials/beyond_context.py report/bouncing.p4dgs
#
# **Files:** [knobs.py](../p4dgs_ref/lab/accuracy/knobs.py) (how the same model is written
# without context), [beyond_networks.py](beyond_networks.py) (coded networks, B1).

# %%
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from p4dgs_ref import decode, encode
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS
from p4dgs_ref.lab.accuracy.knobs import fixed, without_context
from p4dgs_ref.lab.school import lessons
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
# more than they save. As float16 they take 4,112 bytes, and they pay from thousands of anchors on
# (`p4dgs-ref accuracy --only context`); our scenes have 200.
#
# Without them a file would hold one mean, one deviation and one step for each of the 34 channels of
# an anchor. A rate-adaptive encoder could choose the smaller form. We expected this choice to
# matter at our size. But coded networks change the account: their context takes few bytes, and the
# number of anchors from which it pays should fall in proportion.

# %% [markdown]
# ## What the context saves in this file
# This model is written twice more in the paper's design: with its own context, and with one
# Gaussian per channel, which is a hash grid of one node and networks without hidden layers. All
# steps are Q_0 in both files, so that their symbols are the same.

# %%
plain = replace(model, design=model.design._replace(coded=False, position_bits=16), steps=None)


def parts(model):
    """Bytes of the attributes in the file of a model, and of hash grid and context networks."""
    found = components(encode(model))
    attributes = sum(found[name] for name in ATTRIBUTE_SECTIONS)
    return attributes, found["hash_grid"] + found["context_mlps"]


trained, context_bytes = parts(fixed(plain))
alone, moments = parts(without_context(plain))
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
# The saving per anchor is taken to stay the same where there are more anchors. The cost of coded
# networks is that of the file. It would grow with the anchors, but only where this saves more than
# it costs.

# %%
most = model.primitives
for name, cost in costs.items():
    print(f"{name}: pays from {most * cost / saved:,.0f} anchors")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
anchors = np.array([60, 6000])
left.loglog(most, saved, "s", label="saved by the context")
left.loglog(anchors, saved * anchors / most, ":", color=lessons.COLORS[0])
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
#   percent. With them it saves 67 of this file's 9,026 bytes, or 223, 2.5 %, in a format made for
#   it, which would store 136 bytes of means and deviations and no networks.
# - **PSNR.** Trainings with one mean, deviation and step per channel (an experiment before B1 was
#   finished, with networks coded at a similar rate) saved 255 bytes, also 2.5 %, and lost 0.14 dB.
#   Two trainings of one scene differ by as much, so there is no gain to speak of.
# - **Break-even.** With float16 networks the context of this file pays from about 4,000 anchors
#   on, with coded networks from about 270. A context that was trained alone, on the symbols of a
#   trained model, paid from 2,900 and from 230 anchors on. The paper's scenes have tens of
#   thousands.
# - **Time.** The context takes about 6 % of the time in which this file is decoded.
# - **Price of building it.** A second meaning of sections in the format, a flag, a second path in
#   training and in every port.
#
# The rate does what the mode would have done. The bits of $\psi_p$ and $\psi_q$ are in the loss, so
# training keeps only as much of the context as pays: 434 instead of 4,112 bytes in this file.
#
# What these figures leave out: the file's context also chooses a step for every anchor (Eq. 8),
# and the table counts this at nothing. One scene, one seed.
