"""Is a port's answer to one case right?  Count, shape and type first, then every number within c eps S."""

from typing import NamedTuple

import numpy as np

IMAGES = (
    "image",
    "images",
)  # judged as a whole: one S, a bound for the peak and one for the root mean square
PRECISIONS = {"f8": "float64", "f4": "float32"}


class Finding(NamedTuple):
    """What is wrong with one tensor; the numbers are those of its worst element."""

    tensor: str
    kind: str  # missing, extra, shape, dtype, value
    message: str
    index: tuple = ()
    got: float | None = None
    want: float | None = None
    absolute: float | None = None
    relative: float | None = None
    scaled: float | None = None  # |got - want| / (eps S); the bound is c
    bound: float | None = None


class Result(NamedTuple):
    """The verdict on one case."""

    id: str
    equation: str
    level: str
    verdict: str  # pass, fail, acceptable (differs, and may), unasked (not in this precision), or PortError's kind
    required: bool
    findings: tuple  # compare.Finding
    explanation: str

    @property
    def wrong(self):
        return self.required and self.verdict not in ("pass", "unasked")


def expected(tensors):
    """The part of a case's tensors that a port must give: outputs and gradients."""
    return {name: a for name, a in tensors.items() if name.startswith(("out.", "in_bar."))}


def precision(got):
    """float32 where any float tensor has it, else float64: what the port computes in."""
    codes = {
        np.asarray(a).dtype.str[1:]
        for a in expected(got).values()
        if np.asarray(a).dtype.kind == "f"
    }
    return "float32" if "f4" in codes else "float64"


def compare(tensors, got, tolerance):
    """Every way in which `got` {name: array} differs from a case's `tensors`, the worst element first in its tensor.

    Shapes     tensors as read from the vectors, scales among them; tolerance: the record of the port's precision
    """
    want, findings = expected(tensors), []
    for name in got:
        if name.startswith(("out.", "in_bar.")) and name not in want:
            findings.append(Finding(name, "extra", "not expected in this case"))
    for name, right in want.items():
        if name not in got:
            findings.append(Finding(name, "missing", f"expected {right.dtype} {right.shape}"))
            continue
        mine = np.asarray(got[name])
        if mine.shape != right.shape:
            findings.append(Finding(name, "shape", f"{mine.shape}, expected {right.shape}"))
        elif wrong := _wrong_type(mine, right):
            findings.append(Finding(name, "dtype", f"{mine.dtype}, expected {wrong}"))
        elif right.dtype.kind == "f":
            findings += _numbers(name, mine, right, tensors["scale." + name], tolerance)
        elif not np.array_equal(mine, right):
            index = tuple(int(i) for i in np.argwhere(mine != right)[0])
            findings.append(
                Finding(
                    name,
                    "value",
                    _said(name, index, mine[index], right[index]),
                    index,
                    float(mine[index]),
                    float(right[index]),
                )
            )
    return findings


def _wrong_type(mine, right):
    if right.dtype.kind == "f":
        return "" if mine.dtype.str[1:] in PRECISIONS else "float64 or float32"
    if right.dtype.kind == "b":
        return (
            ""
            if mine.dtype.kind == "b" or mine.dtype.kind in "iu" and np.isin(mine, (0, 1)).all()
            else "bool"
        )
    return "" if mine.dtype.kind in "iu" else "integers"


def _said(name, index, got, want):
    for form in (".9g", ".17g") if isinstance(want, np.floating) else ("d",):
        mine, right = (
            f"{v:{form}}" for v in ((got, want) if form != "d" else (int(got), int(want)))
        )
        if mine != right:
            break
    return f"{name}{list(index) if index else ''}: got {mine}, expected {right}"


def deviations(mine, right, scale, precision_of):
    """|got - want| in units of eps S, element by element; infinite where a NaN or an unequal infinity stands.

    The smallest normal number is free: what is smaller has few digits, and much hardware makes it 0.
    """
    with np.errstate(all="ignore"):
        absolute = np.abs(mine.astype(float) - right)
        beyond = np.maximum(absolute - np.finfo(precision_of).tiny, 0)
        scaled = np.where(
            beyond == 0, 0, beyond / (np.finfo(precision_of).eps * scale.astype(float))
        )
    same = mine == right
    absolute, scaled = (np.where(same, 0, np.nan_to_num(a, nan=np.inf)) for a in (absolute, scaled))
    return absolute, scaled


def _numbers(name, mine, right, scale, tolerance):
    if not right.size:
        return []
    absolute, scaled = deviations(mine, right, scale, mine.dtype)
    bound, image = tolerance["eps_S"], name.split(".")[1] in IMAGES
    largest = scaled.max()
    rms = (
        float(largest * np.sqrt(((scaled / largest) ** 2).mean()))
        if image and 0 < largest < np.inf
        else float(largest)
    )
    index = np.unravel_index(np.argmax(scaled), scaled.shape)
    if scaled[index] <= bound and (not image or rms <= tolerance["rms_eps_S"]):
        return []
    with np.errstate(all="ignore"):
        relative = float(absolute[index] / abs(right[index])) if right[index] else np.inf
    said = _said(name, tuple(map(int, index)), mine[index], right[index])
    off = int((scaled > bound).sum())
    said += (
        f" ({off} of {scaled.size} numbers off; worst {scaled[index]:.3g} eps S, allowed {bound:g}"
    )
    said += f"; root mean square {rms:.3g}, allowed {tolerance['rms_eps_S']:g})" if image else ")"
    return [
        Finding(
            name,
            "value",
            said,
            tuple(map(int, index)),
            float(mine[index]),
            float(right[index]),
            float(absolute[index]),
            relative,
            float(scaled[index]),
            float(bound),
        )
    ]
