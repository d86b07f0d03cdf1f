# %% [markdown]
# # Eq. (15): rate against distortion, in real bytes
#
# **Promise.** After this you can draw an honest rate-distortion curve, and say what $\lambda_{rate}$ does to steps and files.
# **Before it:** `17_four_stages`. **Takes** nine seconds on two cores, half an hour of yours.

# %%
import copy

import numpy as np

from p4dgs_ref import decode, encode, evaluate, load_scene, oracle
from p4dgs_ref.codec.inspect import components
from p4dgs_ref.equations import likelihood, rate_loss, total_loss
from p4dgs_ref.model import context
from p4dgs_ref.school import lessons
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer

plt = lessons.pyplot()

# %% [markdown]
# ## Claim
# A small file and a good picture are two wishes. One number says how many units of loss a bit (per coded number) is worth:
# $$\mathcal{L}_{total} = \lambda_{rate}\mathcal{L}_{rate} + \mathcal{L}_{render} \tag{15}$$
# Train once for each $\lambda_{rate}$, and every training gives one point of the curve of what is possible.

# %% [markdown]
# ## By hand
# A number can be coded in three ways: A costs 6 bits and leaves the error 0.01, B costs 3 and leaves 0.05, C costs 1 and leaves
# 0.3. With $\lambda = 0.005$ A is the cheapest, with 0.02 B, with 0.2 C. No one has to know how many bits there are to spend.

# %%
ways = {"A": (6, 0.01), "B": (3, 0.05), "C": (1, 0.3)}
best = lambda price: min(ways, key=lambda way: price * ways[way][0] + ways[way][1])
assert ways == {"A": (6, 0.01), "B": (3, 0.05), "C": (1, 0.3)}
assert [best(price) for price in (0.005, 0.02, 0.2)] == ["A", "B", "C"]

# %% [markdown]
# ## In code
# `tiny`, cut to 60 anchors and narrow networks, goes through the first three stages once, 350 iterations. From that state the
# last stage is trained 150 iterations for each of four prices. The paper names no
# prices. Those of HAC, whose prior it follows, span a factor of 8; ours, for so few iterations, a factor of 64.

# %%
scene = load_scene("bouncing")
changes = dict(
    anchors=60,
    d=6,
    hidden=(12, 12),
    deformation=(24, 24),
    L_x=3,
    L_t=3,
    context=(8,),
    grid_3d=(6,),
    grid_2d=(10,),
    F=1,
    stage_ends=(50, 70, 350, 500),
    decay_from=350,
    grow_from=20,
    grow_every=20,
    grow_until=280,
    mask_from=350,
    lr_q=(0.02, 0.002),
    lr_p=(0.02, 0.002),
)
start = Trainer(scene, choose("tiny", changes), seed=0)
while start.stage < 4:
    start.step()
arrays, state = start.state()
assert (
    start.preset.anchors == 60 and start.iteration == 350 and start.preset.iterations - 350 == 150
)
assert 4e-3 / 5e-4 == 8 and 6.4e-2 / 1e-3 == 64


def branch(price):
    """Stage 4 from the common state at one price."""
    trainer = Trainer(scene, choose("tiny", {**changes, "lambda_rate": price}), seed=0)
    trainer.restore({name: np.array(a) for name, a in arrays.items()}, copy.deepcopy(state))
    while trainer.iteration < trainer.preset.iterations:
        losses = trainer.step()[0]
    return trainer, losses


def measured(price):
    """What counts: the bytes of the file, and the pictures of what was decoded from it."""
    trainer, losses = branch(price)
    data = encode(trainer.model())
    decoded = decode(data)
    part = components(data)
    q = context(trainer.design, trainer.networks, trainer.grids, trainer.located)[0].q.mean(axis=0)
    return dict(
        price=price,
        bytes=len(data),
        attributes=sum(part[n] for n in ("features", "scales", "offset_scales", "offsets")),
        grid=part["hash_grid"],
        networks=sum(part[n] for n in part if n.endswith("mlps") or n.endswith("mlp")),
        estimate=losses.bits / 8,
        psnr=evaluate(decoded, scene)[0]["psnr_db"],
        q=q,
        model=decoded,
        trainer=trainer,
    )


points = [measured(price) for price in (1e-3, 4e-3, 1.6e-2, 6.4e-2)]
print("lambda   file  attributes  grid  networks  estimate  PSNR      mean steps of f, s, l, O")
for m in points:
    print(
        f"{m['price']:.4f}  {m['bytes']:5d}  {m['attributes']:10d}  {m['grid']:4d}  {m['networks']:8d}  {m['estimate']:8.0f}"
        f"  {m['psnr']:.2f} dB ",
        *(f"{v:.4f}" for v in m["q"]),
    )
column = lambda name: np.array([m[name] for m in points])
assert all((np.diff(column(name)) < 0).all() for name in ("bytes", "attributes"))
assert column("psnr")[0] > column("psnr")[3] + 0.5

# %% [markdown]
# Each point is a file that was written and read again. What the price acts on are attributes and grid; networks, header and
# positions cost the same at every price. On so small a scene they are most of the file: say so beside every ratio.

# %%
fixed = column("bytes") - column("attributes") - column("grid")
assert np.ptp(fixed) < 0.02 * fixed.mean() and (fixed > column("attributes")).all()
figure, (curve, bars) = plt.subplots(1, 2, figsize=(12.5, 4.8), layout="constrained")
curve.plot(column("attributes") + column("grid"), column("psnr"), "o-", ms=9)
for m in points:
    at = m["attributes"] + m["grid"], m["psnr"]
    curve.annotate(rf"$\lambda$ = {m['price']:g}", at, xytext=(12, -18), textcoords="offset points")
curve.set(
    xlabel="attributes and grid in the file (bytes)",
    ylabel="decoded test views, PSNR (dB)",
    title="More bytes, better pictures",
)
curve.margins(0.2)
bottom = np.zeros(len(points))
for name, part in (
    ("header, positions, masks", fixed - column("networks")),
    ("networks", column("networks")),
    ("attributes", column("attributes")),
    ("grid", column("grid")),
):
    bars.bar(range(len(points)), part, bottom=bottom, label=name)
    bottom += part
bars.set(
    xticks=range(len(points)),
    xticklabels=[f"{m['price']:g}" for m in points],
    xlabel=r"$\lambda_{rate}$",
    ylabel="file (bytes)",
    title="What the price acts on, and what not",
    ylim=(0, 1.45 * bottom.max()),
)
bars.legend(ncols=2, loc="upper center", fontsize=11)
lessons.show(figure, "27_rate_distortion")

# %%
view = scene.test[2]
figure, panels = plt.subplots(1, 5, figsize=(14, 3.9), layout="constrained")
for ax, m in zip(panels, points):
    ax.imshow(m["model"].render(view.camera, view.time).clip(0, 1)), ax.axis("off")
    ax.set_title(rf"$\lambda$ = {m['price']:g}" f"\n{m['attributes']} bytes", fontsize=14)
panels[4].imshow(view.image), panels[4].axis("off"), panels[4].set_title("truth", fontsize=14)
figure.suptitle("The same view from the four files; bytes of the attributes", fontsize=16)
lessons.show(figure, "27_rate_distortion_pictures")

# %% [markdown]
# ## Backward by hand
# Which step does training choose? One number, step $q$ small beside $\sigma$. The noise costs $w q^2/12$, where $w$ says how much
# the picture minds; the bits are those of a density: $R = c - \log_2 q$. Both slopes, and where they cancel:
# $$\frac{wq}{6} - \frac{\lambda}{q\ln 2} = 0 \quad\Longrightarrow\quad q^* = \sqrt{\frac{6\lambda}{w\ln 2}}.$$

# %%
rng, w = np.random.default_rng(27), 0.5
mean_cost = lambda q, price: w * q**2 / 12 - price * np.log2(q)
steps = np.linspace(0.01, 0.5, 4901)
for price in (1e-3, 4e-3):
    assert (
        abs(steps[mean_cost(steps, price).argmin()] - np.sqrt(6 * price / (w * np.log(2)))) < 1e-4
    )

# %% [markdown]
# Does Eq. (11) agree with $R = c - \log_2 q$? Its $q$ acts twice: in the width of the bin, and in the noise $\tilde f = f + uq$,
# which also moves. The mean of both gradients over many numbers must be $-1/(q\ln 2)$.

# %%
count, q, sigma = 400_000, 0.05, 1.0
f, u = sigma * rng.normal(size=(count, 1)), rng.random((count, 1)) - 0.5
column_of = lambda value: np.full((count, 1), value)
res = likelihood.forward(f + u * q, column_of(0.0), column_of(sigma), column_of(q))[1]
bars_of = likelihood.backward(res, np.ones((count, 1)))
slope = (bars_of["q"] + u * bars_of["f_noisy"]).mean()
print(f"dR/dq: by Eq. (11) {slope:.3f}, by -1/(q ln 2) {-1 / (q * np.log(2)):.3f}")
assert abs(slope * q * np.log(2) + 1) < 0.01

# %% [markdown]
# So four times the price doubles the step: one bit less for every number, and an error four times as large, 6.02 dB. This is the
# law of a codec's quantiser at high rate. Where $q$ nears $\sigma$ it ends, for bits cannot fall below 0.

# %%
assert np.isclose(np.sqrt(4), 2) and np.log2(2) == 1 and round(10 * np.log10(4), 2) == 6.02
wide = likelihood.forward(
    np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), np.full((1, 1), 20.0)
)[0].bits[0, 0]
assert 0 <= wide < 1e-6

# %% [markdown]
# Did ours obey? The steps of f and O rise with the price, but far less than the law says: Eq. (8) has a ceiling, $2Q_0$, here
# 0.5, 0.02, 0.02 and 0.2, and the highest price presses all four against it. From there on bits fall only where
# the numbers and the prior move toward each other. A ceiling that is touched says: choose a larger $Q_0$.

# %%
ceiling, growth = 2 * np.array(start.design.Q_0), points[-1]["q"] / points[0]["q"]
print(
    "steps at the highest price over steps at the lowest:",
    growth.round(2),
    "; the law says",
    np.sqrt(64).round(2),
)
assert (
    np.allclose(ceiling, [0.5, 0.02, 0.02, 0.2])
    and (growth[[0, 3]] > 1.3).all()
    and (points[-1]["q"] > 0.99 * ceiling).all()
)

# %% [markdown]
# ## Break it
# "For the best picture, set $\lambda_{rate} = 0$." The picture is indeed about as good. But then $\psi_p$ receives no gradient at
# all: it stays as random as at the start. Nothing in the loss shows it; the size of the file does.

# %%
free, paid = measured(0.0), points[0]
assert free["price"] == 0 and all(
    np.array_equal(a, arrays[f"p/psi_p.{kind}{i}"])
    for kind, part in zip("Wb", free["trainer"].networks["psi_p"])
    for i, a in enumerate(part)
)
assert free["attributes"] > 1.5 * paid["attributes"] and abs(free["psnr"] - paid["psnr"]) < 0.5
print(
    f"price 0: {free['attributes']} bytes of attributes, {free['psnr']:.2f} dB; "
    f"price {paid['price']:g}: {paid['attributes']} bytes, {paid['psnr']:.2f} dB"
)

# %% [markdown]
# ## What a codec does with it
# A video encoder's quality setting is this price: it fixes the exchange rate, not the size. And an estimate is not a file:
# Eqs. (13) and (14) leave out positions, masks, networks, header. Here they are over 80 percent of the bytes.

# %%
left_out = 100 * (1 - column("estimate") / column("bytes"))
overhead = (column("attributes") + column("grid")) / column("estimate") - 1
print(
    "left out by the estimate:",
    left_out.round(1),
    "percent; streams over estimate:",
    (100 * overhead).round(1),
    "percent",
)
assert (left_out > 80).all() and (np.abs(overhead) < 0.25).all()

# %% [markdown]
# ## Exercises
# **27.1** At which price are the ways A and B of "By hand" equally good? **27.2** A feature has $w = 2$; which step is best at
# $\lambda = 0.001$? **27.3** Write the backward of Eq. (17): `bits` is the sum of both rates, `L_rate` is
# `bits` over `n_parameters` (zero where there are none).

# %%
answer_1 = ...
answer_2 = ...


def my_backward(inputs, cotangents):
    """{"R_anchor", "R_hash"}, from cotangents["bits_bar"], cotangents["L_rate_bar"]; inputs: R_anchor, R_hash, n_parameters."""
    raise NotImplementedError


lessons.number("27.1", answer_1, (ways["B"][1] - ways["A"][1]) / (ways["A"][0] - ways["B"][0]))
lessons.number("27.2", answer_2, np.sqrt(6 * 0.001 / (2 * np.log(2))))
lessons.backward("27.3", my_backward, "rate_loss")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rate_loss`, then `--only total_loss`. What a port gets wrong: $\lambda_{rate}$ times the
# plain sum of bits. Its curve looks fine, but each scene needs other prices: ours would differ by the number of coded numbers.

# %%
for key, module in (("rate_loss", rate_loss), ("total_loss", total_loss)):
    vjp = lambda inputs, bars: module.backward(module.forward(**inputs)[1], **bars)
    verdict = oracle.check(lambda **inputs: module.forward(**inputs)[0], key, vjp)
    print(verdict)
    assert verdict.ok
