"""Two sources of answers: a folder that a port wrote, and a Python function.

A port that runs as a process is in `adapter.py`.
"""

from pathlib import Path

import numpy as np

from ..limits import cut
from . import safetensors
from .compare import expected, precision
from .published import flatten, meant, stream_rows, subjects
from .safetensors import require

ROLES = "out.", "in_bar."  # outputs and gradients: the tensors that a port is asked for


class PortError(Exception):
    """A port gave no answer to a case. The message is one line.

    `kind` is missing, damaged, died, hung, nonsense, error, skipped, absent (of a subject that the
    port says it lacks) or unasked.
    """

    def __init__(self, kind, message):
        super().__init__(" ".join(cut(message).split()))
        self.kind = kind


class FolderPort:
    """The answers that a port wrote: `<subject>.safetensors` or `<subject>.npz`.

    The tensors are named "<case>/out.x". Its folder `codec` holds what it found in the streams.
    """

    def __init__(self, folder):
        """Raises TensorError where a file bears no subject's name."""
        self.folder = Path(folder)
        self.loaded = {}  # subject -> (arrays, file)
        streams = [row["name"] for row in stream_rows()]
        for place, known in (self.folder, subjects()), (self.folder / "codec", streams):
            for file in sorted(place.glob("*.safetensors")) + sorted(place.glob("*.npz")):
                require(file.stem in known, f"{file}: name", meant(file.stem, known))

    def run(self, case):
        """Return the tensors of one case.

        Raises PortError, and TensorError where a tensor bears the name of no case.
        """
        if case.subject not in self.loaded:
            arrays, file = self.loaded[case.subject] = self.load(case.subject)
            known = [row["name"] for row in subjects()[case.subject]["cases"]]
            for name in arrays:
                label, _, tensor = name.partition("/")
                require(label in known, f"{file}: {name}: case {label!r}", meant(label, known))
                require(
                    not tensor.startswith("scale."),
                    f"{file}: {name}",
                    "expected a port's answers, got the published vectors",
                )
        arrays, file = self.loaded[case.subject]
        prefix = case.name + "/"
        tensors = {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}
        if not tensors:
            answers = {name.partition("/")[2]: a for name, a in arrays.items()}
            asked = expected(case.tensors).keys() - case.unasked(precision(answers))
            raise PortError(
                "missing" if asked else "unasked", f"{file}: no tensor named {case.name}/..."
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
        """Return the arrays that the port found in a stream and None, or None and its refusal.

        Raises PortError.
        """
        file = self.folder / "codec" / "refusals.json"
        reasons = safetensors.json_object(file.read_bytes()) if file.is_file() else {}
        if reasons is None or not isinstance(reasons.get(name), str | None):
            raise PortError(
                "damaged",
                f"{file}: expected a JSON object "
                "{name of a stream: the reason of its refusal, or null}",
            )
        if reasons.get(name) is not None:
            return None, reasons[name]
        try:
            return self.load(f"codec/{name}")[0], None
        except PortError as error:
            if error.kind == "missing" and name in reasons:  # null: not refused, no arrays given
                return {}, None
            raise PortError(error.kind, f"{error}, or why it is refused in {file}") from None


class FunctionPort:
    """A Python function as a port. It may return any arrays that `np.asarray` reads."""

    def __init__(self, forward, vjp=None):
        self.forward, self.vjp, self.asked = forward, vjp, ROLES if vjp else ROLES[:1]

    def run(self, case):
        """Call the function with the inputs of a case. Raises PortError."""
        inputs = case.inputs()
        try:
            got = _arrays(_named(self.forward(**inputs), case), "out.", case)
            cotangents = case.cotangents()
            if self.vjp is not None and cotangents:
                got.update(_arrays(self.vjp(inputs, cotangents), "in_bar.", case))
        except Exception as error:  # any failure of a port is its verdict
            raise PortError("error", f"{type(error).__name__}: {error}") from None
        return got


def _named(out, case):
    """Return a function's outputs as {name: value}."""
    if isinstance(out, dict):
        return out
    names = dict.fromkeys(n.split(".")[1] for n in case.tensors if n.startswith("out."))
    several = isinstance(out, tuple) or len(names) > 1
    return dict(zip(names, out if several else (out,), strict=True))


def _arrays(values, prefix, case):
    """Return the values as flat arrays; a value is a list where the case's tensor is one."""
    given = {
        name: list(value) if f"{prefix}{name}.0" in case.tensors else np.asarray(value)
        for name, value in values.items()
        if value is not None
    }
    return flatten(given, prefix)
