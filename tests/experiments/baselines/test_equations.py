"""The equations of the other methods: gradients against differences, and values by hand."""

import numpy as np
import pytest

from tutorials.experiments.baselines import (
    activations,
    conditional,
    deformation_d3dgs,
    marginal,
    plane_decoder,
    plane_features,
    plane_losses,
    rotation_4d,
    sh_color,
    spherindrical,
)

RNG = np.random.default_rng(21)
UNIT = RNG.normal(size=(5, 3))
UNIT /= np.linalg.norm(UNIT, axis=1, keepdims=True)
R, _ = rotation_4d.forward(RNG.normal(size=(5, 4)), RNG.normal(size=(5, 4)))
AXES = plane_features.AXES


def normal(*shape):
    return RNG.normal(size=shape)


def layers(shapes):
    """Random weights and biases."""
    return [normal(*shape) / np.sqrt(shape[0]) for shape in shapes], [normal(n) for _, n in shapes]


def planes(*levels, F=2):
    """Random planes, with the nodes along x, y, z and t of every level."""
    return [normal(n[i], n[j], F) + 1 for n in levels for i, j in AXES]


DECODER = layers([(6, 3), (3, 5), (5, 5), (5, 3), (5, 5), (5, 3), (5, 5), (5, 4)])
LO, HI = np.array([-1.0, -2, 0]), np.array([3.0, 1, 5])
INSIDE = LO + (HI - LO) * RNG.uniform(0.02, 0.98, (7, 3))
D3 = deformation_d3dgs.deformation_layers(1, 2, (9, 8, 7), (3, 3, 4), (6, 5), True)
EQUATIONS = {  # inputs, of which those that are data stand last
    "D1": (activations, [normal(5, 3) - 2, normal(5, 4), 3 * normal(5)]),
    "D2": (sh_color, [UNIT, 0.1 * normal(5, 3, 16)]),
    "D2, degree 1": (sh_color, [UNIT, 0.1 * normal(5, 3, 4)]),
    "D2, clamped": (sh_color, [UNIT, normal(5, 3, 9)]),
    "D3": (
        deformation_d3dgs,
        [normal(5, 3), 0.3, *layers(D3["psi_d"]), *layers(D3["psi_t"]), 1, 2],
    ),
    "H1": (plane_features, [INSIDE, 0.43, LO, HI, planes((2, 3, 4, 5), (3, 2, 3, 3))]),
    "H1, outside": (plane_features, [3 * INSIDE, 1.0, LO, HI, planes((2, 3, 4, 5))]),
    "H2": (plane_decoder, [normal(5, 6), *DECODER]),
    "H3": (plane_losses, [planes((2, 3, 4, 5), (3, 2, 4, 2))]),
    "G1": (rotation_4d, [normal(5, 4), 3 * normal(5, 4)]),
    "G2": (conditional, [normal(5, 3), RNG.random(5), RNG.uniform(0.1, 1, (5, 4)), R, 0.37]),
    "G3": (marginal, [RNG.random(5), RNG.random(5), RNG.uniform(0.01, 0.3, 5), 0.37]),
    "G4": (spherindrical, [normal(5, 3, 4, 9), RNG.random(5), 0.37]),
}


def leaves(value):
    """The arrays in an output or an input, in order."""
    return (
        [a for one in value for a in leaves(one)] if isinstance(value, (tuple, list)) else [value]
    )


def outputs(equation, inputs):
    """The output as one vector."""
    return np.concatenate([np.ravel(a) for a in leaves(equation.forward(*inputs)[0])])


@pytest.mark.parametrize("equation, inputs", EQUATIONS.values(), ids=EQUATIONS)
def test_backward_is_the_adjoint_of_the_derivative(equation, inputs):
    """<bar, J v> = <backward(bar), v> for random bar and v, J v by differences."""
    output, saved = equation.forward(*inputs)
    bars = [normal(*np.shape(a)) for a in leaves(output)]
    gradients = equation.backward(saved, *bars)
    code = equation.forward.__code__
    names = code.co_varnames[: code.co_argcount]
    assert set(gradients) <= set(names)
    bar = np.concatenate([np.ravel(a) for a in bars])
    for name, gradient in gradients.items():
        i = names.index(name)
        steps, value = [1e-6 * normal(*np.shape(a)) for a in leaves(inputs[i])], inputs[i]
        moved = []
        for sign in (1, -1):
            near = [a + sign * v for a, v in zip(leaves(value), steps)]
            near = near if isinstance(value, list) else near[0]
            moved.append(outputs(equation, [*inputs[:i], near, *inputs[i + 1 :]]))
        wanted = (moved[0] - moved[1]) @ bar / 2
        found = sum((np.asarray(g) * v).sum() for g, v in zip(leaves(gradient), steps))
        assert found == pytest.approx(wanted, rel=1e-5, abs=1e-13), name


# --- values by hand, which a forward and a backward with one mistake would not have ---


def test_stored_numbers_become_a_gaussian():
    inputs = np.log([[2.0, 4, 8]]), np.array([[1.0, 2, 2, 4]]), np.log([3.0])
    (s, r, alpha), _ = activations.forward(*inputs)
    assert s[0] == pytest.approx([2, 4, 8]) and r[0] == pytest.approx([0.2, 0.4, 0.4, 0.8])
    assert alpha == pytest.approx([0.75])


def test_harmonics_are_orthonormal():
    """Over the sphere, by a product of Gauss and equal angles that is exact to degree 6."""
    z, weight = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * np.pi / 8
    ring = np.sqrt(1 - z**2)
    d = np.stack(
        [np.outer(ring, np.cos(phi)), np.outer(ring, np.sin(phi)), z[:, None] + 0 * phi], 2
    )
    Y, _ = sh_color.basis(d.reshape(-1, 3), 16)
    area = np.repeat(weight * np.pi / 8, 16)
    assert Y.T @ (area[:, None] * Y) == pytest.approx(np.eye(16), abs=1e-12)
    dark = np.array([-2, 0, 2])[None, :, None] * 2 * np.sqrt(np.pi)
    assert sh_color.forward(np.array([[0.0, 0, 1]]), dark)[0][0] == pytest.approx([0, 0.5, 2.5])


def test_planes_are_read_bilinearly_and_multiplied():
    """Planes that are linear in x, y and t give the product of the three fractions."""
    n, fractions = (3, 4, 2, 5), [np.linspace(0, 1, count) for count in (3, 4, 2, 5)]
    linear = [np.ones((n[i], n[j], 1)) for i, j in AXES]
    linear[0] = np.multiply.outer(fractions[0], fractions[1])[:, :, None]
    linear[5] = np.ones((2, 1, 1)) * fractions[3][None, :, None]
    middle = np.array([[1.0, -0.5, 2.5]])
    assert plane_features.forward(middle, 0.25, LO, HI, linear)[0] == pytest.approx(0.0625)


def test_roughness_by_hand():
    """A ramp has the slopes 3 and -2; j^2 has the second difference 2."""
    i, j = np.indices((4, 5))
    ramp, square, ones = (3.0 * i - 2 * j)[..., None], (1.0 + j * j)[..., None], np.ones((4, 5, 1))
    losses, _ = plane_losses.forward([ramp, ones, ones, square, ones, ones])
    assert losses == pytest.approx((13, 4, 6))


def test_rotations_in_four_dimensions():
    one, i = np.array([[1.0, 0, 0, 0]]), np.array([[0.0, 1, 0, 0]])
    third = np.array([[1.0, 1, 1, 1]])  # sends x to y, y to z and z to x
    turn, _ = rotation_4d.forward(third, 2 * third)
    assert turn[0] == pytest.approx(np.eye(4)[[2, 0, 1, 3]])
    left, right = (rotation_4d.forward(*pair)[0][0] for pair in ((i, one), (one, i)))
    assert left == pytest.approx(
        np.array([[0, 0, 0, 1], [0, 0, -1, 0], [0, 1, 0, 0], [-1, 0, 0, 0]])
    )
    assert right == pytest.approx(
        np.array([[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]])
    )


def test_a_slice_of_a_gaussian_in_space_and_time():
    """The conditional distribution, from the inverse of the 4D covariance."""
    _, inputs = EQUATIONS["G2"]
    x, mu_t, s, turned, t = inputs
    (x_t, Sigma_t, var_t), _ = conditional.forward(*inputs)
    for n in range(len(x)):
        precision = turned[n] @ np.diag(s[n] ** -2.0) @ turned[n].T
        Sigma = np.linalg.inv(precision[:3, :3])
        assert Sigma_t[n] == pytest.approx(Sigma, rel=1e-9, abs=1e-12)
        assert x_t[n] == pytest.approx(x[n] - Sigma @ precision[:3, 3] * (t - mu_t[n]), rel=1e-9)
        assert var_t[n] == pytest.approx(np.linalg.inv(precision)[3, 3])


def test_fading_and_waves_by_hand():
    half = 0.5 / np.log(2)
    (alpha, weight), _ = marginal.forward(np.array([0.8]), np.array([-0.5]), np.array([half]), 0.5)
    assert (alpha[0], weight[0]) == pytest.approx((0.4, 0.5))
    sh = normal(1, 3, 3, 1)
    quarter, _ = spherindrical.forward(sh, np.array([0.25]), 0.5)
    assert quarter == pytest.approx(sh[:, :, 0] - sh[:, :, 2])
