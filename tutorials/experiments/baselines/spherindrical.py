"""G4: spherical harmonics whose coefficients change with time (spherindrical harmonics).

    sh_t = sum_n cos(2 pi n (t - mu_t)) sh_n        n = 0 ... T-1

Yang et al. 2023 (4DGS). The colour is then D2 of sh_t. The series has a period of 1, the length of
a scene.

The backward pass of the authors' kernel is not the derivative of its forward pass: the slope along
time has the wrong sign and only the highest harmonic. `backward` is the derivative.
"""

import numpy as np


def forward(
    sh,  # [N, 3, T, K]  coefficients of red, green and blue for every wave in time
    mu_t,  # [N]  means in time
    t,  # []  time of the picture
):
    """Return sh_t [N, 3, K] and what `backward` needs."""
    frequency = 2 * np.pi * np.arange(sh.shape[2], dtype=sh.dtype)
    phase = frequency * (t - mu_t)[:, None]
    waves = np.cos(phase)
    slopes = frequency * np.sin(phase)  # along mu_t
    return np.einsum("nt,nctk->nck", waves, sh), (sh, waves, slopes)


def backward(saved, sh_t_bar):
    """Gradients of sh and mu_t."""
    sh, waves, slopes = saved
    return {
        "sh": np.einsum("nt,nck->nctk", waves, sh_t_bar),
        "mu_t": np.einsum("nt,nctk,nck->n", slopes, sh, sh_t_bar, optimize=True),
    }
