"""The gradient test, and comparisons of arrays and of lists of arrays alike."""

import numpy as np

EPS = np.finfo(float).eps
STEPS = (1e-2, 1e-3, 1e-4, 1e-5)


def leaves(a):
    """The arrays of an array or of a list of arrays."""
    return [np.asarray(b) for b in a] if isinstance(a, list) else [np.asarray(a)]


def like(a, new):
    """`new` (a list of arrays) in the form of `a`: a list for a list, an array for an array."""
    return new if isinstance(a, list) else new[0]


def is_float(a):
    """Whether a value consists of floating-point arrays."""
    return len(leaves(a)) > 0 and all(b.dtype.kind == "f" for b in leaves(a))


def dot_terms(a, b):
    """The terms of the scalar product of two values."""
    return np.concatenate([np.zeros(0), *((x * y).ravel() for x, y in zip(leaves(a), leaves(b)))])


def cast(a, dtype):
    """Float arrays in another precision; Python's numbers, integers and masks stay."""
    if isinstance(a, list):
        return [cast(b, dtype) for b in a]
    return a.astype(dtype) if isinstance(a, (np.ndarray, np.generic)) and a.dtype.kind == "f" else a


def draw_cotangents(outputs, draw):
    """A cotangent draw(shape) for every float output."""
    return {
        name + "_bar": np.asarray(draw(np.shape(a)), np.asarray(a).dtype)
        for name, a in outputs.items()
        if is_float(a)
    }


def close(got, want, tolerance, what):
    """Assert that `got` is within `tolerance` of the largest wanted magnitude, or EPS if that is 0.

    Infinities and integers agree exactly.
    """
    for g, w in zip(leaves(got), leaves(want), strict=True):
        assert g.shape == w.shape, f"{what}: shape {g.shape}, expected {w.shape}"
        finite = np.isfinite(w) if g.dtype.kind == "f" else np.zeros(w.shape, bool)
        assert np.array_equal(g[~finite], w[~finite]), f"{what}: {g} where {w} was expected"
        if not finite.any():
            continue
        worst = np.abs(g[finite] - w[finite]).max()
        bound = tolerance * np.abs(w[finite]).max() or EPS
        assert worst <= bound, f"{what}: off by {worst:.3g}, allowed {bound:.3g}"


def slope(f, cotangents, h):
    """The terms of <cotangents, J d> by a fourth-order central difference of f(step)."""
    plus_2, minus_2, plus, minus = (f(step * h) for step in (2, -2, 1, -1))
    terms = []
    for bar, cotangent in cotangents.items():
        name = bar.removesuffix("_bar")
        near = np.subtract(plus[name], minus[name])
        far = np.subtract(plus_2[name], minus_2[name])
        terms.append(dot_terms(cotangent, (8 * near - far) / (12 * h)))
    return np.concatenate(terms)


def check_adjoint(eq, case, smooth):
    """Check <y_bar, J d> = <J^T y_bar, d> for random y_bar and d, one input at a time.

    `eq` has a key, gradients and vjp; `smooth` is the function that its pullback differentiates.
    """
    rng = np.random.default_rng(0)
    outputs, pullback = eq.vjp(**case.inputs)
    cotangents = draw_cotangents(outputs, rng.standard_normal)
    gradients = pullback(**cotangents)
    # A difference cannot see what is lost in the last bits of its outputs.
    products = [dot_terms(a, outputs[n.removesuffix("_bar")]) for n, a in cotangents.items()]
    rounding = 4 * EPS * sum(np.abs(terms).sum() for terms in products)
    for name in eq.gradients:
        x = case.inputs[name]
        d = [rng.normal(size=b.shape) * np.where(b == 0, 1, np.abs(b)) for b in leaves(x)]
        ours = dot_terms(gradients[name], d)

        def f(step):
            moved = [b + step * e for b, e in zip(leaves(x), d)]
            return smooth(**{**case.inputs, name: like(x, moved)})

        errors = []  # in units of what is allowed
        for h in STEPS:
            theirs = slope(f, cotangents, h)
            allowed = 1e-7 * (np.abs(ours).sum() + np.abs(theirs).sum()) + rounding / h
            errors.append(abs(ours.sum() - theirs.sum()) / allowed if allowed != 0 else 0.0)
        found = ", ".join(f"{error:.1e} (step {h})" for error, h in zip(errors, STEPS))
        where = f"{eq.key}, case {case.name}, input {name}"
        assert any(error <= 1 for error in errors), f"{where}: off by {found}"
