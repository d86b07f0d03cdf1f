"""The kernels of NumPy and its BLAS: the same ones on every processor give the same bytes.

Both choose their kernels to suit the processor. Other kernels add in another order, so the last
digits differ. Those for AVX2 run on nearly every x86-64 processor since 2015, so `prepare` chooses
them.
"""

import ctypes
import os
import platform
import sys
import warnings

CHOSEN = "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"  # variables that choose the kernels
BLAS = "Haswell"  # the name of the kernels for AVX2 in OpenBLAS
OWN = "the processor's own"
PROMISED = f"{BLAS}, AVX2, 1 thread"  # what `kernels` reports after `prepare` chose them
# The features above AVX2, by the first NumPy version with these names; it warns of other names.
FEATURES = {
    (2, 4): "X86_V4 AVX512_ICL AVX512_SPR",
    (2, 3): "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
    (1, 26): "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
}
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # the names of glibc in malloc.h


def prepare() -> None:
    """Choose kernels and the number of BLAS threads, and tune the allocator, before NumPy loads.

    Variables that are already set stay as they are. With `P4DGS_KERNELS=native`, on a system other
    than Linux, or without AVX2 and FMA, the kernels are left to the processor.

    The matrix products here are thin: a second BLAS thread gains nothing and costs waiting. glibc
    returns every large temporary array to the system and pays its page faults again in the next
    step, unless it is told to keep them.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    if os.environ.get("P4DGS_KERNELS") != "native" and has_avx2():
        choose_kernels()
    keep_pages()


def keep_pages():
    """Tell glibc to keep the pages of large arrays; worker processes call it for themselves."""
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt  # its name on Linux, and nowhere else
        mallopt(M_MMAP_THRESHOLD, 1 << 30)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    except (OSError, AttributeError):
        pass  # another C library: the page faults cost time, nothing else changes


def has_avx2():
    """Return whether Linux says that the processor has AVX2 and FMA.

    Under emulation /proc/cpuinfo is that of the host, so the name of the machine is asked first.
    """
    if platform.machine() != "x86_64":
        return False
    flags = next((line for line in lines_of("/proc/cpuinfo") if line.startswith("flags")), "")
    return {"avx2", "fma"} <= set(flags.split())


def lines_of(path):
    """Return the lines of a file if this is Linux and the file is there; otherwise none."""
    try:
        with open(path, encoding="utf-8", errors="surrogateescape") as file:
            return [*file] if sys.platform == "linux" else []
    except OSError:
        return []


def choose_kernels():
    """Ask for the AVX2 kernels before NumPy loads; warn if it has already loaded others."""
    from importlib.metadata import version

    release = tuple(map(int, version("numpy").split(".")[:2]))
    names = next(names for since, names in FEATURES.items() if release >= since)
    wanted = dict(zip(CHOSEN, (BLAS, names.replace(" ", ","))))
    if "numpy" not in sys.modules:
        os.environ.update({**wanted, **os.environ})
    elif not wanted.keys() <= os.environ.keys() and kernels() == OWN:
        warnings.warn(f"NumPy was imported before prepare(): the kernels are {OWN}", stacklevel=3)


def kernels():
    """Return the kernels in force, as NumPy and each OpenBLAS of this process report them."""
    import numpy as np

    core = (getattr(np, "_core", None) or np.core)._multiarray_umath
    features, dispatched = core.__cpu_features__, core.__cpu_dispatch__
    above = {name for names in FEATURES.values() for name in names.split()}
    same = features.get("AVX2") and features.get("FMA3") and features.get("X86_V3", True)
    same = same and not any(features[name] for name in above.intersection(dispatched))
    names, threads = zip(*openblas() or [("", 0)])
    if not same or set(names) != {BLAS}:
        return OWN
    return f"{BLAS}, AVX2, {max(threads)} thread{'s' * (max(threads) > 1)}"


def other_kernels():
    """Return a warning if other kernels are in force although the promised ones are available."""
    found = kernels()
    if found == PROMISED or not (has_avx2() and openblas()):
        return ""
    return (
        f"the kernels are {found}, not {PROMISED}: the same seed may give other bytes on other "
        "machines; call p4dgs_ref.prepare() before NumPy is imported, without P4DGS_KERNELS=native"
    )


def openblas():
    """Return the name of the kernels and the number of threads of each OpenBLAS that is loaded."""
    paths = {line.split(maxsplit=5)[-1].strip() for line in lines_of("/proc/self/maps")}
    libraries = sorted(path for path in paths if "openblas" in os.path.basename(path))
    answers = []
    for library in map(ctypes.CDLL, libraries):
        for form in ("openblas_{}", "openblas_{}64_", "scipy_openblas_{}", "scipy_openblas_{}64_"):
            name = getattr(library, form.format("get_corename"), None)
            if name:
                name.restype = ctypes.c_char_p
                threads = getattr(library, form.format("get_num_threads"))
                answers.append((name().decode(), threads()))
    return answers


def arithmetic():
    """Return what last digits depend on: this package, NumPy, SciPy, and the kernels in force."""
    import numpy as np
    import scipy

    from .version import __version__

    versions = f"p4dgs_ref {__version__}, NumPy {np.__version__}, SciPy {scipy.__version__}"
    return f"{versions}, kernels: {kernels()}"
