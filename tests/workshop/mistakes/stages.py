"""Known mistakes between equations: each is right, but what one gives to the next is not."""

import numpy as np

from p4dgs_ref.codec.file import decode
from p4dgs_ref.equations import deformation, deformed
from tests.workshop.mistakes.kit import given_as, known, port, surgery
from tests.workshop.pipeline import drawn_from, frames_vjp
from tests.workshop.subjects import subjects


# --- Fig. 1 -------------------------------------------------------------------------------------
def scales_exchanged(tree, *_):
    return {**tree, "l_a": tree["s_a"], "s_a": tree["l_a"]}


def deformation_seen(given, cotangents):
    """The gradient of x that comes back from E(x) is added."""
    out, bars = port("temporal_prediction")(given, cotangents)
    delta, res = deformation.forward(
        given["x"],
        given["t"],
        given["psi_d_weights"],
        given["psi_d_biases"],
        given["L_x"],
        given["L_t"],
    )
    _, res_t = deformed.forward(given["x"], given["s"], given["r"], *delta)
    moved = deformed.backward(res_t, **cotangents)
    x_bar = deformation.backward(res, moved["delta_x"], moved["delta_s"], moved["delta_r"])["x"]
    return out, {**bars, "x": bars["x"] + x_bar}


def mask_multiplied(given, cotangents):
    """All children whose opacity times the mask reaches tau_alpha, with that opacity."""
    mask = given["mask"].ravel()
    everything = {**given, "mask": np.ones_like(given["mask"]), "tau_alpha": -2.0}
    out, pullback = subjects()["spatial_prediction"].vjp(**everything)
    out["alpha"] = out["alpha"] * mask
    kept = out["alpha"] >= given["tau_alpha"]
    whole = {f"{name}_bar": np.zeros_like(a) for name, a in out.items() if name != "index"}
    if kept.sum() == len(next(iter(cotangents.values()), kept)):
        for name, bar in cotangents.items():
            whole[name][kept] = bar
    whole["alpha_bar"] *= mask
    return {name: a[kept] for name, a in out.items()}, pullback(**whole)


def colors_overwritten(given, _):
    """The last outputs of psi_r stand in the memory from which those of psi_c are read."""
    view = {name: value for name, value in given.items() if name != "stream"}
    drawn = drawn_from(decode(given["stream"].tobytes()))
    layers, rows = [*drawn["psi_r_weights"]], len(drawn["psi_c_weights"][0])
    columns = 3 * drawn["mask"].shape[1]
    layers[-1] = layers[-1][:, :columns]
    layers[0] = np.pad(layers[0], ((0, rows - len(layers[0])), (0, 0)))  # psi_r may see no view
    *biases, last = drawn["psi_r_biases"]
    wrong = {"psi_c_weights": layers, "psi_c_biases": [*biases, last[:columns]]}
    return frames_vjp(**drawn | wrong, **view, renderer="exact")[0], {}


RENDERING = [
    surgery(
        "pictures",
        "pictures-network-overwritten",
        "the networks share one output: that of psi_c is overwritten by psi_r's before it is used",
        colors_overwritten,
    ),
    surgery(
        "spatial_prediction",
        "stage-mask-multiplied",
        "masks only multiply opacities; at tau_alpha = 0 masked children stay, with opacity 0",
        mask_multiplied,
    ),
    known(
        "temporal_prediction",
        "stage-time-symmetric",
        "the time from 0 to 1 is mapped to -1 to 1 before E(t)",
        **given_as(t=lambda given: 2 * given["t"] - 1),
    ),
    known(
        "spatial_prediction",
        "stage-l-and-s-exchanged",
        "l_a and s_a are exchanged: s_a scales the offsets",
        inputs=scales_exchanged,
        inputs_bar=scales_exchanged,
    ),
    surgery(
        "temporal_prediction",
        "stage-gradient-through-encoding",
        "a gradient flows back from E(x) into x, where the pipeline stops it (Q10)",
        deformation_seen,
    ),
]


# --- Fig. 2 -------------------------------------------------------------------------------------
def of_offsets(change):
    """mu and sigma with the 3k columns of O changed: (A, k, 3) -> its other order, flattened."""

    def columns(tree, given):
        first = -3 * given["k"]
        return {
            **tree,
            **{
                name: np.concatenate([tree[name][:, :first], change(tree[name][:, first:])], axis=1)
                for name in ("mu", "sigma")
            },
        }

    return columns


def coordinate_major(O):
    return O.reshape(len(O), O.shape[1] // 3, 3).swapaxes(1, 2).reshape(O.shape)


def child_major(O):
    return O.reshape(len(O), 3, O.shape[1] // 3).swapaxes(1, 2).reshape(O.shape)


def middle_exchanged(q, *_):
    return q[:, [0, 2, 1, 3]]


def living(given):
    """All numbers over those that are coded: of masked offsets none."""
    total = given["noisy"].size
    return total / (total - 3 * np.count_nonzero(~given["mask"]))


CODING = [
    known(
        "context_stage",
        "stage-offsets-coordinate-major",
        "mu and sigma of O are flattened as (3, k) instead of (k, 3)",
        outputs=of_offsets(coordinate_major),
        outputs_bar=lambda bars, out, given: of_offsets(child_major)(bars, given),
    ),
    known(
        "rate_stage",
        "stage-steps-exchanged",
        "the steps of s and l are exchanged: q is read as f, l, s, O",
        inputs={"q": middle_exchanged},
        inputs_bar={"q": middle_exchanged},
    ),
    known(
        "rate_stage",
        "stage-masked-not-counted",
        "L_rate is divided by the numbers that are coded, masked offsets left out",
        outputs=lambda out, given: {**out, "L_rate": out["L_rate"] * living(given)},
        outputs_bar=lambda bars, out, given: {**bars, "L_rate": bars["L_rate"] * living(given)},
    ),
]

MISTAKES = [*RENDERING, *CODING]
