# %% [markdown]
# # Accuracy versus time: how to read a work-precision diagram
#
# **Promise.** After this you can read a diagram of error against time, draw one that is fair, and
# choose a setting by it. **Before it:** `10_prior_and_likelihood`, `15_compositing`. **Takes** five
# seconds on two cores, 25 minutes of reading and 45 of exercises.
#
# **Files:** [forms.py](../p4dgs_ref/lab/accuracy/forms.py),
# [formulas.py](../p4dgs_ref/lab/accuracy/formulas.py), [clock.py](../p4dgs_ref/lab/clock.py).

# %%
import math

import numpy as np
from scipy.special import ndtr, roots_legendre

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, shared

plt = figures.pyplot()
architecture.show("23_accuracy_versus_time", "compositing", "likelihood")


def phi(x):
    return np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)


# %% [markdown]
# ## Claim
# "Fast" alone says nothing, and neither does "accurate". A method is a point $(t_i, e_i)$ of time
# and error, and a method with a parameter is a line of such points. Only those methods are worth
# having that no other method beats in both respects. They form the *Pareto front*:
# $$i \text{ is dominated} \iff
#   \text{there is a } j \text{ with } t_j \le t_i \text{ and } e_j \le e_i,
#   \text{ one of them strictly.}$$


# %%
def front(points):
    """Which rows (time, error) are not dominated."""
    on_front = []
    for point in points:
        no_worse = (points <= point).all(axis=1)
        better = (points < point).any(axis=1)
        on_front.append(not (no_worse & better).any())
    return on_front


four = np.array([[1.0, 1e-2], [3.0, 1e-5], [4.0, 1e-3], [3.0, 1e-6]])
assert front(four) == [True, False, False, True]

# %% [markdown]
# ## By hand
# The mass of a bin in Eq. (11) is an integral of the density $\phi(x) = e^{-x^2/2}/\sqrt{2\pi}$.
# From $-0.5$ to $0.5$ it is 0.382925. One trapezoid,
# $T_1 = \frac12\phi(-0.5) + \frac12\phi(0.5)$, gives 0.352065. Two trapezoids,
# $T_2 = \frac12 T_1 + \frac12\phi(0)$, give 0.375504. The errors are 0.030860 and 0.007421: twice
# as many trapezoids have about a quarter of the error.

# %%
true = 2 * ndtr(0.5) - 1
one = 0.5 * phi(-0.5) + 0.5 * phi(0.5)
two = 0.5 * one + 0.5 * phi(0)
assert np.allclose([true, one, two], [0.382925, 0.352065, 0.375504], rtol=0, atol=5e-7)
assert np.allclose([true - one, true - two], [0.030860, 0.007421], rtol=0, atol=5e-7)
print(f"ratio of the errors {(true - one) / (true - two):.2f}")

# %% [markdown]
# With $n$ trapezoids the error is $C n^{-2}$ plus smaller terms. In the combination
# $(4T_2 - T_1)/3$ the constant $C$ cancels. It is 0.383317, with an error of 0.000392 from the
# same values of $\phi$. This is Simpson's rule, and its error decreases as $n^{-4}$.

# %%
simpson = (4 * two - one) / 3
assert round(simpson, 6) == 0.383317
assert round(simpson - true, 6) == 0.000392

# %% [markdown]
# On logarithmic axes $e = C n^{-p}$ is a straight line of slope $-p$, so **the slope is the order
# of the method**. A third rule, by Gauss and Legendre, also chooses the points at which $\phi$ is
# evaluated; its curve bends down faster than any power. Two of the three rules reach a **floor**
# below 1e-15. There the error consists of rounding, and more work gains nothing. We count work in
# evaluations of $\phi$.


# %%
def trapezoids(n):
    y = phi(np.linspace(-0.5, 0.5, n + 1))
    return (y[0] / 2 + y[1:-1].sum() + y[-1] / 2) / n


def simpsons(n):
    return (4 * trapezoids(n) - trapezoids(n // 2)) / 3


def gauss(n):
    x, weight = roots_legendre(n)
    return 0.5 * weight @ phi(x / 2)


def error_of(value):
    return max(abs(value - true), 1e-17)  # a logarithmic axis cannot show zero


doubled = [2**i for i in range(1, 15)]
work = {
    "trapezoids": [n + 1 for n in doubled],
    "Simpson": [n + 1 for n in doubled],
    "Gauss and Legendre": [2, 4, 8, 16],
}
error = {
    "trapezoids": [error_of(trapezoids(n)) for n in doubled],
    "Simpson": [error_of(simpsons(n)) for n in doubled],
    "Gauss and Legendre": [error_of(gauss(n)) for n in work["Gauss and Legendre"]],
}
for name, least, most in (("trapezoids", 1.9, 2.1), ("Simpson", 3.9, 4.1)):
    slope, _ = np.polyfit(np.log(doubled[:5]), np.log(error[name][:5]), 1)
    print(f"order of {name}: {-slope:.2f}")
    assert least < -slope < most
assert max(min(error[name]) for name in ("Simpson", "Gauss and Legendre")) < 1e-15
assert min(error["trapezoids"]) > 1e-11

# %%
figure, axes = plt.subplots(figsize=(9, 5.4), layout="constrained")
for name, marker in zip(work, "osD"):
    axes.loglog(work[name], error[name], marker=marker, label=name.replace(" and ", "\nand "))
axes.axhspan(1e-17, 2.2e-16, color="0.9")
axes.text(20, 3e-17, "floor: rounding of float64", fontsize=12)
arrow = dict(arrowstyle="->")
axes.annotate("slope $-2$", (360, 2.6e-7), xytext=(900, 3e-6), fontsize=13, arrowprops=arrow)
axes.annotate("slope $-4$", (45, 1.8e-9), xytext=(90, 3e-8), fontsize=13, arrowprops=arrow)
figures.finish(
    axes,
    xlabel="work (values of $\\phi$)",
    ylabel="error of the bin's mass",
    ylim=(1e-17, 0.1),
    title="One integral, three rules: the slope is the order, the floor is the format",
)
figures.label(
    axes,
    (5, 8e-3),
    (150, 6e-11),
    (7, 1e-10),
)
figures.show(figure, "23_accuracy_versus_time_order")

# %% [markdown]
# ## In code
# `p4dgs-ref accuracy` asks four such questions of this project and answers them in a minute. Here
# are two of them on a small scale. A *form* of a function is a way to compute it; each form is
# timed, and its result is compared with the truth. The first function is the renderer, which has
# three settings. `exact`, which is the truth here, evaluates every pair of a Gaussian and a pixel
# in `float64`. `fast` ends a Gaussian where its opacity falls below a **cut**, which is the
# parameter of this diagram. `kernel` has the constants of the published kernel: a square box of
# three standard deviations, and no opacity below $1/255$ at any pixel.

# %%
from functools import partial

from p4dgs_ref.lab.accuracy import forms, formulas
from p4dgs_ref.lab.clock import alternate, differ
from p4dgs_ref.splatting import fast
from p4dgs_ref.splatting.settings import FAST, KERNEL

settings = {("setting `fast`", ""): FAST, ("setting `kernel`", ""): KERNEL}
for dtype in ("float32", "float64"):
    for cut in ("1/255", "5e-5", "1e-6"):
        value = 1 / 255 if "/" in cut else float(cut)
        settings[f"cut labelled, {dtype}", cut] = FAST._replace(cut=value, dtype=dtype)
scene = forms.splat_scene(300, 48)
truth = forms.exact_image(scene)
pixels = scene["height"] * scene["width"]
times = alternate(
    {key: partial(fast.forward, **scene, settings=s) for key, s in settings.items()}, 5
)
drawn = {}
for key, chosen in settings.items():
    (image, _), (tiles, *_) = fast.forward(**scene, settings=chosen)
    gap = image - truth
    pairs = sum(opacities.size for _, _, opacities, *_ in tiles)
    drawn[key] = times[key].ms, np.abs(gap).max(), pairs, np.sqrt((gap**2).mean())
    print(
        f"{' '.join(key):27s} {times[key].ms:6.2f} ms, {pairs:7,} pairs, error {drawn[key][1]:.1e}"
    )
of_fast, of_kernel = list(drawn.values())[:2]
assert max(pairs for _, _, pairs, _ in drawn.values()) < 300 * pixels / 2
assert of_fast[1] < of_kernel[1] and of_fast[2] < of_kernel[2]

# %% [markdown]
# Measured in pairs, `kernel` is dominated: `fast` evaluates fewer pairs and has a smaller error,
# because its tiles follow the ellipse instead of a square box. But is `fast` accurate *enough*? A
# picture with 8 bits per value is rounded by up to half of 1/255, which is 0.00196. The error of
# `kernel` is larger than this, that of `fast` is smaller.

# %%
half_step = 0.5 / 255
assert round(half_step, 5) == 0.00196
assert of_fast[1] < half_step < of_kernel[1]

# %% [markdown]
# The second function is Eq. (11), the bits of a symbol, of which the project has five formulas.
# They are measured on bins of a usual width up to 3 standard deviations from the mean, and on the
# whole domain of distances and widths for which the project promises its digits, on both sides of
# the mean. Near the mean, all of them are accurate to better than one percent. In the whole domain
# the formula *as printed* is infinite or NaN in 28.7 % of the bins: in 34.5 % of those above the
# mean and in 22.9 % of those below.
#
# The other four are these. *HAC's floor*: in this earlier codec the mass never falls below
# $10^{-6}$. *Mirrored* subtracts on the side where $\Phi$ is small. *Table* interpolates $\Phi$
# between $256$ entries per standard deviation, or as many as the diagram says. *Ours* is the
# formula that `10_prior_and_likelihood` derives.

# %%
domains = {
    "to 3 σ": forms.bins(((1e-2, 3), (1e-2, 10)), 2000),
    "everywhere": forms.bins(n=2000),
}
choices = {(d, name): f for d in domains for name, f in formulas.FORMULAS.items()}
for entries in (16, 64, 256, 1024, 4096):
    choices["to 3 σ", f"{entries}/σ"] = formulas.lookup_table(entries)
priced, calls = {}, {}
for (domain, name), formula in choices.items():
    z, w = domains[domain]
    bits_error, slopes_error = formulas.errors(formula, z, w, "float64")
    priced[domain, name] = bits_error.max(), slopes_error.max()
    calls[domain, name] = partial(formula, **formulas.inputs(z, w, "float64"))
with np.errstate(all="ignore"):
    times_11 = alternate(calls, 3)
for (domain, name), (error_of_bits, _) in priced.items():
    ns = 1e6 * times_11[domain, name].ms / 4000  # each call computes 4000 bins
    print(f"{name:18s} {domain:10s}: {ns:5.1f} ns, error of the bits {error_of_bits:.1e}")
    assert domain == "everywhere" or name.endswith("/σ") or error_of_bits < 0.01
assert priced["everywhere", "ours"][0] < 1e-12

z, w = forms.bins()
failed = {
    name: ~np.isfinite(formulas.errors(formulas.FORMULAS[name], z, w, "float64")[0])
    for name in ("as printed", "mirrored")
}
shares = [failed["as printed"][where].mean() for where in (z > 0, z < 0, z != 0)]
assert np.round(100 * np.array(shares), 1).tolist() == [34.5, 22.9, 28.7]
assert round(100 * failed["mirrored"].mean(), 1) == 22.9

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(15, 6.6), layout="constrained")


def draw(panel, name, points, **style):
    """A line through points {label: (time, error)}, with the label beside each."""
    panel.loglog(*zip(*points.values()), label=name, **style)
    for label, place in points.items():
        panel.annotate(label, place, (7, 4), textcoords="offset points", fontsize=12)


for i, name in enumerate(dict.fromkeys(name for name, _ in drawn)):
    points = {label: row[:2] for (of, label), row in drawn.items() if of == name}
    draw(left, name, points, marker="*osD"[i], markersize=15 if i == 0 else 8)
left.axhline(half_step, color="0.4", ls="--", label="half a step of an 8-bit picture")
left.set(
    title="Rendering: down is better, left is faster",
    ylabel="largest error of the picture (of 1)",
    xlabel="processor time (ms, forward)",
)
near = {
    name: (times_11[d, name].ms, error) for (d, name), (error, _) in priced.items() if d[0] == "t"
}
tables = {name: point for name, point in near.items() if name.endswith("/σ")}
draw(right, "table, entries labelled", tables, marker="o")
for name, marker in (("as printed", "s"), ("mirrored", "D"), ("ours", "*")):
    draw(right, name, {"": near[name]}, marker=marker, markersize=15 if marker == "*" else 8)
right.set(
    title="Eq. (11) to 3 σ in float64: what the last digits cost",
    ylabel="largest relative error",
    xlabel="processor time (ms, 4000 values)",
)
for panel in (left, right):
    panel.margins(0.2)
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter("{x:g}")
    panel.legend(fontsize=12, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.13))
figures.show(figure, "23_accuracy_versus_time")

# %% [markdown]
# The numbers beside the points are the parameters: the cut on the left, the entries per standard
# deviation on the right. Read such a diagram in this order. What is the **truth** that errors are
# measured against? How good must the result **be**? Draw that line. Which method is **leftmost
# below** the line? Only then look at slopes and floors, and at what the diagram does not show: a
# method that fails on *other* inputs looks as good here as any other.
#
# How far can a measured time be trusted? Measure one function under two names. The two times
# differ because other programs run on the same machine, so methods whose times differ by less
# must be regarded as equal. The project measures methods in turn, so that a disturbance affects
# all of them. It takes the processor's clock, which stands still while other programs run, and
# prints the median with both quartiles. Where these are as far apart as two medians, it says that
# it cannot tell which method is faster.

# %%
from p4dgs_ref.equations import likelihood

x = np.linspace(-3, 3, 2000)[None]
zeros, ones = np.zeros_like(x), np.ones_like(x)


def call():
    likelihood.forward(x, zeros, ones, 0.1 * ones)


twice = alternate({"once": call, "again": call}, 5)
print("median and quartiles in ms:", {n: np.round(t[:3], 3).tolist() for n, t in twice.items()})
print("they can be told apart:", differ(twice["once"], twice["again"]))

# %% [markdown]
# Some questions take longer than a minute. How long should a training be? A
# [record](experiments/README.md#how-long-to-train-and-what-effects-gain) has trainings of
# `bouncing` with all of the 3,800 iterations, half of them and a quarter, with three seeds each.
# Half of the time costs 1.3 dB, a quarter of it 3.3 dB: all three points are on the front.

# %%
from p4dgs_ref.lab.writer import group_rows, read_csv

lengths = read_csv(shared.FOLDER / "experiments" / "records" / "training.csv")
reached = {}
for (iterations,), runs in group_rows(lengths, "iterations").items():
    seconds, psnr = np.array([(row["train_seconds"], row["psnr_db"]) for row in runs]).T
    reached[iterations] = np.median(seconds), psnr.mean()
    print(f"{iterations:5,} iterations: {np.median(seconds):3.0f} s, {psnr.mean():.2f} dB")
whole, *shorter = (psnr for _, psnr in reached.values())
assert [round(whole - psnr, 1) for psnr in shorter] == [1.3, 3.3]
assert all(front(np.array([(time, -psnr) for time, psnr in reached.values()])))

# %% [markdown]
# ## Backward by hand
# A gradient has an error of its own. Let $g$ be the straight line between the values of $f$ at
# two nodes with the distance $h$. At distance $s$ from the left node,
# $$f = f_0 + f'_0s + \tfrac12 f''_0s^2 + O(h^3),$$
# $$g = f_0 + \tfrac{s}{h}(f_h - f_0) = f_0 + f'_0s + \tfrac12 f''_0hs + O(h^3),$$
# $$g - f = \tfrac12 f''_0\,s(h-s) + O(h^3), \qquad g' - f' = \tfrac12 f''_0\,(h-2s) + O(h^2).$$
# The error of the value is largest in the middle, $\frac18 f''_0h^2$. The error of the derivative
# is largest at the nodes, $\frac12 f''_0h$, which is **one order less**.

# %%
z_0 = 1.0
second_derivative = -z_0 * phi(z_0)  # of Phi
for n in (64, 256):
    h = 1 / n
    f_0, f_h = ndtr(z_0), ndtr(z_0 + h)
    value_error = (f_0 + f_h) / 2 - ndtr(z_0 + h / 2)
    slope_error = (f_h - f_0) / h - phi(z_0)
    assert np.isclose(value_error, second_derivative * h**2 / 8, rtol=0.02)
    assert np.isclose(slope_error, second_derivative * h / 2, rtol=0.02)

# %% [markdown]
# The tables of Eq. (11) behave exactly like this. With 64 times as many entries the bits are
# better by about $64^2$, but the gradient only by about 64. A diagram of the value alone shows an
# error below 1e-6 and hides an error of almost 1e-3 in the gradient.

# %%
coarse, fine = (np.array(priced["to 3 σ", f"{entries}/σ"]) for entries in (64, 4096))
gain_of_bits, gain_of_gradient = coarse / fine
print(f"gain of the bits {gain_of_bits:.0f}, of the gradient {gain_of_gradient:.0f}")
assert 64**2 / 3 < gain_of_bits < 3 * 64**2
assert 64 / 3 < gain_of_gradient < 3 * 64
assert fine[0] < 1e-6
assert 0.8e-3 < fine[1] < 1e-3

# %% [markdown]
# ## Break it
# Take the printed formula in `float64` as the truth; after all, it is the formula of the paper.
# Now the *better* formula is blamed for the errors of the truth. In bins that are 1e-12 standard
# deviations wide, *ours* seems to have an error of about 1e-6. Nothing in the diagram looks
# suspicious.

# %%
z, w = np.zeros((1, 1)), np.full((1, 1), 1e-12)
ours = likelihood.forward(z, 0 * z, np.ones_like(z), w)[0][0, 0]
printed = formulas.literal(z, 0 * z, np.ones_like(z), w)[0][0, 0]
seeming_error = abs(ours - printed) / abs(printed)
assert 0.5e-6 < seeming_error < 2e-6

# %% [markdown]
# A truth must be checked by something that does not have the same weakness. Quadrature only adds
# positive terms, and 60-digit arithmetic confirms that it is accurate to 2e-14. Measured against
# it, the verdict is the opposite.

# %%
log_p, *_ = formulas.truth(z[0], w[0])
truth = -log_p[0] / math.log(2)
assert max(formulas.check_truth()) < 2e-14
assert abs(ours - truth) / abs(truth) < 1e-15
assert abs(printed - truth) / abs(truth) > 0.5e-6

# %% [markdown]
# ## What a codec does with it
# The lossy parts of a codec may have any error that cannot be seen. Suppose that a model has a
# PSNR of 33 dB, and that the renderer adds an error of its own. In the worst case the two add up
# to $(\sqrt{MSE} + rms)^2$. The loss in dB is the real price of `fast` and `kernel`.

# %%
mse = 10 ** (-33 / 10)


def largest_loss(rms):
    """The largest loss of PSNR by an error of the renderer, a root mean square."""
    return 10 * math.log10((math.sqrt(mse) + rms) ** 2 / mse)


loss, loss_of_kernel = largest_loss(of_fast[3]), largest_loss(of_kernel[3])
print(f"fast loses at most {loss:.4f} dB, kernel {loss_of_kernel:.4f} dB")
assert loss < 0.01 < loss_of_kernel

# %% [markdown]
# The entropy coder is the opposite case. Move the mean of a single symbol among 400 by a
# sixteenth of a step. The price of all symbols changes by less than one bit, and nobody would
# draw a diagram for that. But a decoder that reads with the moved mean loses the rest of the
# stream. The only useful accuracy is equality here, and this is why the tables are computed in
# integers (`22_desync`).

# %%
from p4dgs_ref.codec import streams
from p4dgs_ref.codec.container import BitstreamError

rng = np.random.default_rng(23)
symbols = np.rint(rng.normal(scale=1.5, size=400)).astype(np.int64)
mu = np.zeros(400, np.int64)  # in units of 1/1024 of a step
sigma = np.full(400, 9)  # 16 log2(sigma / step)
moved = mu.copy()
moved[100] += 1024 // 16
price = streams.ideal_bits_gaussian(symbols, mu, sigma).sum()
other_price = streams.ideal_bits_gaussian(symbols, moved, sigma).sum()
assert 0 < abs(other_price - price) < 1
message = streams.encode_gaussian(symbols, mu, sigma)
assert np.array_equal(streams.decode_gaussian(message, mu, sigma), symbols)
try:
    received = streams.decode_gaussian(message, moved, sigma)
    assert not np.array_equal(received, symbols)
except BitstreamError as error:
    print(f"{price:.2f} and {other_price:.2f} bits; the decoder says: {error}")

# %% [markdown]
# ## Exercises
# **23.1** ● Simpson's rule has an error of $10^{-4}$ with $8$ steps. How many steps does it need
# for an error of $10^{-12}$, which is far above the floor?
#
# **23.2** ● Among the rows of `choices` (time, error), which is the cheapest one with an error of
# at most `need`? Give the number of the row.
#
# **23.3** ●●● Compute $\log p$ of a bin and its two derivatives by quadrature, accurately enough
# for the golden vectors and with as few nodes as you can:
# $$p = \int_{z-w/2}^{z+w/2}\!\!\phi, \quad
#   \tfrac{\partial\log p}{\partial z} = \tfrac{\phi(z+w/2) - \phi(z-w/2)}{p}, \quad
#   \tfrac{\partial\log p}{\partial w} = \tfrac{\phi(z+w/2) + \phi(z-w/2)}{2p}.$$
# For example, $p = 0.382925$ at $z = 0$, $w = 1$. Let $a = |z| - w/2$. A bin with $a \ge 0$ lies
# in one tail, and its mass is $\phi(a)$ times the integral of $e^{-a t - t^2/2}$ over
# $0 \le t \le w$. The range may end where the exponent is $-40$. One rule for the whole range
# loses too many digits where the nodes crowd at its ends, so cut it into eight equal pieces; 10 to
# 40 nodes in each then suffice for all bins. A bin with $a < 0$ holds the mean: integrate $\phi$
# itself if $w < 2$; a wider one is one minus two tails, and you may take these from `ndtr`. The
# densities at the two edges have the quotient $e^{-|z| w}$, and narrow bins lose their difference
# unless you compute it with `expm1`.
#
# **Predict, then run.** Simpson's rule computes the mass of $\phi$ from $-\frac12$ to $\frac12$ in
# float16, with every operation rounded. From which number of steps on does its error stop falling?

# %%
answer_1 = answer_2 = ...


def my_bin(z, w):
    """Return log_p, d log p / dz and d log p / dw, each (n,), for z and w (n,)."""
    raise NotImplementedError


choices = np.array(
    [
        [5, 4e-2],
        [34, 3e-6],
        [36, 3e-11],
        [57, 5e-11],
        [67, 8e-15],
        [36, 2e-7],
    ]
)
need = 1e-6
lessons.check_number("23.1", answer_1)
lessons.check_number("23.2", answer_2)
lessons.check_forward("23.3", my_bin, "gaussian_bin")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only gaussian_bin` judges each number relative to the size of its
# own terms. A single absolute tolerance, say 1e-6, would accept a gradient of 0 wherever
# gradients are small, for example in a wide bin, whose symbol is almost certain.


# %%
def port(z, w):
    x, q = z[None], w[None]
    bits, saved = likelihood.forward(x, np.zeros_like(x), np.ones_like(x), q)
    bars = likelihood.backward(saved, np.ones_like(x))
    per_bit = -math.log(2)
    return per_bit * bits[0], per_bit * bars["f_noisy"][0], per_bit * bars["q"][0]


lessons.passes("gaussian_bin", port=port)
