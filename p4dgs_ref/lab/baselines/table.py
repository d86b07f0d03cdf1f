"""The table of the baselines' equations, rows as in `p4dgs_ref.table`.

D belongs to D3DGS, H to 4DHexPlane, G to 4DGS. What a method takes from the paper or from another
method has no second row.
"""

from ...table import BEYOND, EQUATIONS, Equation

_ROWS = (
    Equation(
        "activations",
        "D1",
        "s = exp(log_s), r = raw_r / |raw_r|, alpha = sigmoid(logit_alpha)",
        "p4dgs_ref.lab.baselines.activations",
        ("s", "r", "alpha"),
        ("log_s", "raw_r", "logit_alpha"),
    ),
    Equation(
        "sh_color",
        "D2",
        "color = max(0, 1/2 + sum_k sh_k Y_k(d))",
        "p4dgs_ref.lab.baselines.sh_color",
        ("color",),
        ("d", "sh"),
    ),
    Equation(
        "deformation_d3dgs",
        "D3",
        "(delta_x, delta_s, delta_r) = psi_d(concat(E(x), psi_t(E(t))))",
        "p4dgs_ref.equations.deformation_d3dgs",
        ("delta_x", "delta_s", "delta_r"),
        ("x", "weights", "biases", "time_weights", "time_biases"),
    ),
    Equation(
        "plane_features",
        "H1",
        "features = concat over levels (prod over planes (plane[u_i, u_j]))",
        "p4dgs_ref.lab.baselines.plane_features",
        ("features",),
        ("x", "planes"),
    ),
    Equation(
        "plane_decoder",
        "H2",
        "delta_x, delta_log_s, delta_raw_r = phi_x(h), phi_s(h), phi_r(h), h = relu(phi(features))",
        "p4dgs_ref.lab.baselines.plane_decoder",
        ("delta_x", "delta_log_s", "delta_raw_r"),
        ("features", "weights", "biases"),
    ),
    Equation(
        "plane_losses",
        "H3",
        "L_space = mean (diff P)^2, L_time = mean (diff diff P)^2, L_one = mean |P - 1|",
        "p4dgs_ref.lab.baselines.plane_losses",
        ("L_space", "L_time", "L_one"),
        ("planes",),
    ),
    Equation(
        "rotation_4d",
        "G1",
        "R v = l v conj(r), l = raw_l / |raw_l|, r = raw_r / |raw_r|",
        "p4dgs_ref.lab.baselines.rotation_4d",
        ("R",),
        ("raw_l", "raw_r"),
    ),
    Equation(
        "conditional",
        "G2",
        "x_t = x + b (t - mu_t) / var_t, Sigma_t = A - b b^T / var_t",
        "p4dgs_ref.lab.baselines.conditional",
        ("x_t", "Sigma_t", "var_t"),
        ("x", "mu_t", "s", "R"),
    ),
    Equation(
        "marginal",
        "G3",
        "alpha_t = alpha exp(-(t - mu_t)**2 / (2 var_t))",
        "p4dgs_ref.lab.baselines.marginal",
        ("alpha_t", "weight"),
        ("alpha", "mu_t", "var_t"),
    ),
    Equation(
        "spherindrical",
        "G4",
        "sh_t = sum_n cos(2 pi n (t - mu_t)) sh_n",
        "p4dgs_ref.lab.baselines.spherindrical",
        ("sh_t",),
        ("sh", "mu_t"),
    ),
)

BASELINE_EQUATIONS: dict[str, Equation] = {row.key: row for row in _ROWS}
ALL_EQUATIONS = {**EQUATIONS, **BASELINE_EQUATIONS, **BEYOND}
