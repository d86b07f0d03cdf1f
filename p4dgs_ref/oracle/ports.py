"""Two sources of answers: a folder that a port wrote, and a Python function.

A port that runs as a process is in `adapter.py`.
"""

from pathlib import Path

import numpy as np

from ..messages import shorten
from . import safetensors
from .compare import PRECISIONS, cast, differences, precision
from .published import flatten, stream_rows, subjects, suggestion
from .safetensors import require_tensor

ROLES = "out.", "in_bar."  # outputs and gradients: the tensors that a port is asked for


class PortError(Exception):
    """A port gave no answer to a case. The message is one line.

    `kind` is missing, damaged, died, hung, nonsense, error, skipped, absent (of a subject that the
    port says it lacks) or not_judged.
    """

    def __init__(self, kind, message):
        super().__init__(" ".join(shorten(message).split()))
        self.kind = kind


class FolderPort:
    """The answers that a port wrote: `<subject>.safetensors` or `<subject>.npz`.

    The tensors are named "<case>/out.x". Its folder `codec` holds what it found in the streams.
    """

    def __init__(self, folder):
        """Raises TensorError if a file has no subject's name, or a subject has two files."""
        self.folder = Path(folder)
        self.loaded = {}  # subject -> (arrays, file)
        streams = [row["name"] for row in stream_rows()]
        for place, known in (self.folder, subjects()), (self.folder / "codec", streams):
            for file in sorted(place.glob("*.safetensors")) + sorted(place.glob("*.npz")):
                require_tensor(file.stem in known, f"{file}: name", suggestion(file.stem, known))
                twin = file.with_suffix(".npz")
                require_tensor(
                    file == twin or not twin.exists(), twin, f"expected one file, not also {file}"
                )

    def run(self, case):
        """Return the tensors of one case.

        Raises PortError, and TensorError where a tensor bears the name of no case.
        """
        if case.subject not in self.loaded:
            arrays, file = self.loaded[case.subject] = self.load(case.subject)
            known = [row["name"] for row in subjects()[case.subject]["cases"]]
            for name in arrays:
                label, _, tensor = name.partition("/")
                require_tensor(
                    label in known, f"{file}: {name}: case {label!r}", suggestion(label, known)
                )
                require_tensor(
                    not tensor.startswith("scale."),
                    f"{file}: {name}",
                    "expected a port's answers, got the published vectors",
                )
        arrays, file = self.loaded[case.subject]
        prefix = case.name + "/"
        tensors = {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}
        if not tensors:
            answers = {name.partition("/")[2]: a for name, a in arrays.items()}
            is_judged = case.tolerance(precision(answers)) is not None
            raise PortError(
                "missing" if is_judged else "not_judged", f"{file}: no tensor named {case.name}/..."
            )
        return tensors

    def load(self, subject):
        """Return ({name: array}, file) of a subject. Raises PortError."""
        files = [self.folder / f"{subject}.{suffix}" for suffix in ("safetensors", "npz")]
        file = next(filter(Path.is_file, files), None)
        if file is None:
            raise PortError("missing", f"expected {files[0]} or .npz")
        try:
            if file.suffix == ".npz":
                with np.load(file, allow_pickle=False) as arrays:
                    return dict(arrays), file
            return safetensors.load(file.read_bytes()), file
        except Exception as error:  # NumPy raises whatever its zip, header and type parsers raise
            raise PortError("damaged", f"{file}: {error}") from None

    def decode(self, name, _):
        """Return the arrays that the port found in a stream, and why it refused it, or None.

        Raises PortError, and TensorError if a refusal has the name of no stream.
        """
        file = self.folder / "codec" / "refusals.json"
        reasons = safetensors.json_object(file.read_bytes()) if file.is_file() else {}
        known = [row["name"] for row in stream_rows()]
        for unknown in (reasons or {}).keys() - {*known}:
            raise safetensors.TensorError(f"{file}: {unknown}: {suggestion(unknown, known)}")
        if reasons is None or not isinstance(reasons.get(name), str | None):
            raise PortError(
                "damaged",
                f"{file}: expected a JSON object "
                "{name of a stream: the reason of its refusal, or null}",
            )
        try:
            return self.load(f"codec/{name}")[0], reasons.get(name)
        except PortError as error:
            if error.kind == "missing" and name in reasons:
                return {}, reasons[name]
            raise PortError(error.kind, f"{error}, or why it is refused in {file}") from None


class FunctionPort:
    """A Python function as a port. It may return any arrays that `np.asarray` reads."""

    def __init__(self, forward, vjp=None, dtype="float64"):
        self.forward, self.vjp, self.dtype = forward, vjp, np.dtype(dtype)
        if self.dtype.name not in PRECISIONS:
            raise ValueError(f"dtype {dtype}: expected {' or '.join(PRECISIONS)}")
        self.asked = ROLES if vjp else ROLES[:1]

    @np.errstate(over="ignore")  # beyond float32: infinite, as in every port
    def arguments(self, case):
        """Return the inputs and cotangents of a case, new copies in the precision of the check."""
        return cast(case.inputs(), self.dtype), cast(case.cotangents(), self.dtype)

    def run(self, case):
        """Return the function's answer to a case. Raises PortError."""
        refuse_not_judged(case, self.dtype)
        got = self.answer(case)
        refuse_other_types(case, got, self.dtype)
        return got

    def answer(self, case):
        """Call the function with the inputs of a case; return flat arrays. Raises PortError."""
        arguments = inputs, cotangents = self.arguments(case)
        try:
            got = _arrays(_by_name(self.forward(**inputs), case), "out.", case)
            if self.vjp is not None and cotangents:
                got |= _arrays(self.vjp(inputs, cotangents), "in_bar.", case)
        except (Exception, SystemExit) as error:  # any failure of a port is its verdict
            raise PortError("error", f"{type(error).__name__}: {error}") from None
        for before, after in zip(self.arguments(case), arguments):
            for finding in differences(flatten(before), flatten(after)):
                raise PortError("error", f"the function changes its argument {finding.tensor}")
        return got


def refuse_not_judged(case, dtype):
    """Raise PortError, kind not_judged, where a case is not judged in a precision."""
    if case.tolerance(dtype.name) is None:
        raise PortError("not_judged", case.record["tolerance"][f"{dtype.name}_reason"])


def refuse_other_types(case, got, dtype):
    """Raise PortError, kind nonsense, if floats of an answer do not have the type of the check."""
    for name in case.tensors.keys() & got.keys():
        if case.tensors[name].dtype.kind == "f" and got[name].dtype != dtype:
            message = f"{name}: expected {dtype}, in which the port is checked, got "
            raise PortError("nonsense", f"{message}{got[name].dtype}")


def _by_name(out, case):
    """Return a function's outputs as {name: value}. Raises TypeError."""
    names = dict.fromkeys(n.split(".")[1] for n in case.tensors if n.startswith("out."))
    if isinstance(out, dict):
        return out
    if len(names) == 1 and not isinstance(out, tuple):
        out = (out,)
    if not isinstance(out, (tuple, list)) or len(out) != len(names):
        raise TypeError(f"expected the outputs {', '.join(names)}, got {_description(out)}")
    return dict(zip(names, out))


def _arrays(values, prefix, case):
    """Return the values as flat arrays; a value is a list if the case's tensor or input is one."""
    if not isinstance(values, dict):
        raise TypeError(f"expected a dictionary of gradients, got {_description(values)}")
    arrays = {}
    for name, value in values.items():
        is_list = {f"in.{name}.0", f"out.{name}.0"} & case.tensors.keys()
        if is_list and not isinstance(value, (list, tuple, np.ndarray)):
            raise TypeError(f"{name}: expected a list of arrays, got {_description(value)}")
        if any(map(np.ma.is_masked, value if is_list else [value])):
            raise TypeError(f"{name}: expected an array without masked elements")
        if value is not None:
            arrays[name] = list(value) if is_list else np.asarray(value)
    # The byte order of an array does not matter.
    flat = flatten(arrays, prefix).items()
    return {name: a.astype(a.dtype.newbyteorder("="), copy=False) for name, a in flat}


def _description(value):
    """Return a few words that describe a value of the wrong kind."""
    is_several = isinstance(value, (tuple, list))
    return f"{len(value)} of them" if is_several else f"one {type(value).__name__}"
