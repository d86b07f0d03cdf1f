"""Eq. (1): the centres of the k Gaussians that every anchor predicts.

    x_i = x_a + O_i * l_a        i = 0 ... k-1

P-4DGS, section 3.2 (spatial prediction).
"""


def forward(
    x_a,  # [A, 3]  anchor positions (scene units)
    O_a,  # [A, k, 3]  learned offsets (multiples of l_a)
    l_a,  # [A, 3]  offset scaling (scene units); linear, not its logarithm (Q5)
):
    """Return the canonical centres x [A, k, 3] and what `backward` needs."""
    x = x_a[:, None, :] + O_a * l_a[:, None, :]
    return x, (O_a, l_a)


def backward(saved, x_bar):
    """Return the gradients of x_a, O_a and l_a."""
    O_a, l_a = saved
    return {
        "x_a": x_bar.sum(axis=1),  # one anchor moves all its children: sum over k
        "O_a": x_bar * l_a[:, None, :],
        "l_a": (x_bar * O_a).sum(axis=1),
    }
