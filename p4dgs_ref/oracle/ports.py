"""Where answers come from: a folder that a port wrote, or a Python function; a running process is in adapter.py."""

from pathlib import Path

import numpy as np

from . import safetensors
from .compare import precision
from .subjects import flatten, subjects


class PortError(Exception):
    """A port gave no answer to a case: kind is missing, damaged, died, hung, nonsense, error, skipped or unasked."""

    def __init__(self, kind, message):
        super().__init__(message)
        self.kind = kind


class FolderPort:
    """Answers that a port wrote, `<subject>.safetensors` or `<subject>.npz`, tensors named "<case>/out.x"."""

    def __init__(self, folder):
        self.folder, self.loaded, self.asked = Path(folder), {}, {}
        self.known = set(subjects())

    def run(self, case):
        """The tensors of one case.

        Raises     PortError
        """
        if case.subject not in self.loaded:
            self.loaded[case.subject] = self._load(case.subject)
        self.asked.setdefault(case.subject, set()).add(case.name)
        arrays, path = self.loaded[case.subject]
        found = {
            name[len(case.name) + 1 :]: a
            for name, a in arrays.items()
            if name.startswith(case.name + "/")
        }
        if not found:
            answers = {name.partition("/")[2]: a for name, a in arrays.items()}
            if case.tolerance("float32") is None and precision(answers) == "float32":
                raise PortError("unasked", f"{path}: float32, which this case does not ask for")
            raise PortError("missing", f"{path}: no tensor named {case.name}/...")
        return found

    def _load(self, subject):
        path = next(
            (
                p
                for p in (self.folder / f"{subject}.safetensors", self.folder / f"{subject}.npz")
                if p.is_file()
            ),
            None,
        )
        if path is None:
            raise PortError(
                "missing", f"{self.folder}: expected {subject}.safetensors or {subject}.npz"
            )
        try:
            if path.suffix == ".npz":
                with np.load(path, allow_pickle=False) as file:
                    return dict(file), path
            return safetensors.load(path.read_bytes(), path), path
        except safetensors.TensorError as error:
            raise PortError("damaged", str(error)) from None
        except Exception as error:  # NumPy's reader raises what its zip, header and type parsers do
            raise PortError(
                "damaged", f"{path}: expected a sound npz of numbers ({type(error).__name__})"
            ) from None

    def close(self):
        """Nothing to end here."""

    def strangers(self):
        """`file: tensor` of every tensor that was in no case asked for, and files of no subject at all."""
        files = [p for p in self.folder.iterdir() if p.suffix in (".safetensors", ".npz")]
        return [p.name for p in sorted(files) if p.stem not in self.known] + [
            f"{path.name}: {name}"
            for key, (arrays, path) in self.loaded.items()
            for name in arrays
            if name.split("/")[0] not in self.asked.get(key, ())
        ]


class FunctionPort:
    """A Python function as port; what it returns may be any arrays that `np.asarray` reads."""

    def __init__(self, forward, vjp=None):
        self.forward, self.vjp = forward, vjp

    def run(self, case):
        """Call the function with the case's inputs by name.

        Raises     PortError
        """
        inputs = case.inputs()
        try:
            got = self._outputs(self.forward(**inputs), case)
            if self.vjp is not None and (cotangents := case.cotangents()):
                got.update(self._arrays(self.vjp(inputs, cotangents), "in_bar.", case))
        except Exception as error:  # whatever a port does wrong is its verdict
            raise PortError("error", f"{type(error).__name__}: {error}") from None
        return got

    def _outputs(self, out, case):
        if hasattr(out, "_asdict"):
            out = out._asdict()
        if not isinstance(out, dict):
            names = list(
                dict.fromkeys(n.split(".")[1] for n in case.tensors if n.startswith("out."))
            )
            out = dict(
                zip(names, out if isinstance(out, tuple) or len(names) > 1 else (out,), strict=True)
            )
        return self._arrays(out, "out.", case)

    @staticmethod
    def _arrays(values, prefix, case):
        return flatten(
            {
                n: [np.asarray(b) for b in a] if f"{prefix}{n}.0" in case.tensors else np.asarray(a)
                for n, a in values.items()
                if a is not None
            },
            prefix,
        )
