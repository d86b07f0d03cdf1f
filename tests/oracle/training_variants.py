"""Wrong variants of a training step, which the cases of level L4 must notice.

A row of VARIANTS is a change of the package's own text that stands for a mistake of a port. Before
a release, `python -m tests.oracle.training_variants` replays the cases with each of them and
lists those that no case notices: they must be the six that PASSING gives a reason for. It takes
some minutes; a slow test tries ten.
"""

import importlib
import sys
from contextlib import contextmanager
from importlib.machinery import PathFinder, SourceFileLoader

import numpy as np

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.compare import compare

# The subjects of L4 with trainings, and the function of the workshop that answers them.
ANSWERS = {
    "training": ("replay", "replay"),
    "training_whole": ("replay", "replay"),
    "trace": ("pipeline", "trace_vjp"),
}
SEEN = "self.seen.reshape(-1)[rows] += 1"
CLEARED = "self.gradient[children] = self.seen[children] = 0"
ENOUGH_SEEN = "preset.grow_every * preset.success * 0.5"
ENOUGH_VISITS = "statistics.visits > preset.grow_every * preset.success"
SCHEDULE = "(step - start) / max(until - start, 1)"
# Module, then for each variant: what it does, the text that it replaces, and its own text.
VARIANTS = {
    "training.density": (
        # the sums of the window
        (
            "visits of anchors with a visible child",
            "self.visits += 1",
            "self.visits[rendered.index[rendered.visible] // self.seen.shape[1]] += 1",
        ),
        ("negative opacities too", "np.maximum(rendered.alpha, 0)", "rendered.alpha"),
        (
            "opacities after masking",
            "np.maximum(rendered.alpha, 0)",
            "np.where(np.isin(np.arange(self.seen.size).reshape(self.seen.shape), rendered.index), "
            "rendered.alpha, 0)",
        ),
        ("opacity of the last view", "self.opacity += np", "self.opacity[...] = np"),
        ("gradient in x per pixel", "x_bar * camera.width / 2", "x_bar"),
        ("gradient in y per pixel", "y_bar * camera.height / 2", "y_bar"),
        ("width for height", "camera.height / 2", "camera.width / 2"),
        ("squared gradient", "length[rendered.visible]", "length[rendered.visible] ** 2"),
        ("gradient of the last view", "[rows] += length", "[rows] = length"),
        ("seen behind the camera", SEEN, SEEN.replace("rows", "rendered.index")),
        ("every child is seen", SEEN, "self.seen += 1"),
        ("an anchor is seen", SEEN, "self.seen[rows // self.seen.shape[1]] += 1"),
        (
            "the same number, written otherwise",
            "np.maximum(rendered.alpha, 0)",
            "rendered.alpha * (rendered.alpha > 0)",
        ),
        # a new window
        ("all gradients are cleared", CLEARED, "self.gradient[...] = self.seen[...] = 0"),
        ("no gradient is cleared", CLEARED, "pass"),
        ("seen is not cleared", CLEARED, "self.gradient[children] = 0"),
        ("gradients are not cleared", CLEARED, "self.seen[children] = 0"),
        ("gradients are cleared by anchor", CLEARED, CLEARED.replace("children", "anchors")),
        ("opacities are not cleared", "self.opacity[anchors] = self", "self"),
        ("visits are not cleared", "= self.visits[anchors] = 0", "= 0"),
        ("all opacities are cleared", "self.opacity[anchors] = self", "self.opacity[...] = self"),
        ("sums of kept anchors are lost", "sums[keep]", "0 * sums[keep]"),
        ("sums of new anchors are one", "np.zeros((count, *sums", "np.ones((count, *sums"),
        # who grows
        ("centres by the scale", 'np.exp(p["log_l"])', 'np.exp(p["log_s"])'),
        ("centres by a logarithm", 'np.exp(p["log_l"])', 'p["log_l"]'),
        (
            "gradient per visit",
            "np.maximum(statistics.seen, 1)",
            "np.maximum(statistics.visits[:, None], 1)",
        ),
        (
            "gradient of all views",
            "statistics.gradient / np.maximum(statistics.seen, 1)",
            "1 * statistics.gradient",
        ),
        ("one threshold for all levels", "(preset.grow_hierarchy // 2) ** level", "1"),
        (
            "threshold times 4 a level",
            "(preset.grow_hierarchy // 2) **",
            "preset.grow_hierarchy **",
        ),
        (
            "threshold halved a level",
            "preset.gradient_threshold * (",
            "preset.gradient_threshold / (",
        ),
        ("> for >= the threshold", "gradient >= threshold", "gradient > threshold"),
        ("or for and", "ravel() & (gradient", "ravel() | (gradient"),
        ("however rarely seen", ".ravel() & (gradient", ".ravel() * 0 + 1 & (gradient"),
        ("draws above 1/2, 3/4, 7/8", "> 0.5 ** (level + 1)", "> 1 - 0.5 ** (level + 1)"),
        ("draws above 1/2 always", "> 0.5 ** (level + 1)", "> 0.5"),
        ("draws above 1, 1/2, 1/4", "> 0.5 ** (level + 1)", "> 0.5**level"),
        ("draws below", "> 0.5 ** (level + 1)", "< 0.5 ** (level + 1)"),
        ("no draws", "wanted &= rng.random(len(x)) >", "wanted &= 1 + rng.random(len(x)) >"),
        ("levels after an empty one", "if level and not len(x_a)", "if False"),
        (
            "draws of the levels that are looked at",
            "wanted &= rng.random(len(x)) >",
            "wanted &= (not level or len(x_a) > 0) and rng.random(len(x)) >",
        ),
        # where
        (
            "voxels from small to large",
            "grow_hierarchy**level, 1)",
            "grow_hierarchy**(2 - level), 1)",
        ),
        ("voxels half as large a level", "preset.grow_hierarchy**level, 1)", "2**level, 1)"),
        ("old anchors do not occupy", '[p["x_a"], x_a]) / size', '[p["x_a"][:0], x_a]) / size'),
        ("new anchors do not occupy", '[p["x_a"], x_a]) / size', '[p["x_a"], x_a[:0]]) / size'),
        ("floor for occupied voxels", "np.round(np.concatenate", "np.floor(np.concatenate"),
        ("floor for candidates", "np.round(x[wanted]", "np.floor(x[wanted]"),
        (
            "the first feature",
            "np.maximum(largest.get(voxel, feature), feature)",
            "largest.get(voxel, feature)",
        ),
        ("the last feature", "np.maximum(largest.get(voxel, feature), feature)", "feature"),
        ("the smallest feature", "np.maximum(largest.get", "np.minimum(largest.get"),
        (
            "the sum of features",
            "np.maximum(largest.get(voxel, feature), feature)",
            "largest.get(voxel, 0) + feature",
        ),
        (
            "features of other anchors",
            'np.repeat(p["f_a"], p["O_a"].shape[1], axis=0)',
            'np.tile(p["f_a"], (p["O_a"].shape[1], 1))',
        ),
        ("voxels as they come", "sorted(largest)", "[*largest]"),
        ("voxels by z first", "sorted(largest)", "sorted(largest, key=lambda voxel: voxel[::-1])"),
        ("corner of the voxel", "x.dtype) * size", "x.dtype) * size - size / 2"),
        ("size for its logarithm", "3), np.log(size))", "3), size)"),
        ("new anchors do not reach", '"log_l": log_size', '"log_l": 0 * log_size'),
        ("offsets of new anchors", "np.zeros((len(x_a)", "np.ones((len(x_a)"),
        # enough views, and who dies
        (">= for > half a window", f"> {ENOUGH_SEEN}", f">= {ENOUGH_SEEN}"),
        ("a whole window for children", ENOUGH_SEEN, "preset.grow_every * preset.success"),
        (">= for > a window", ENOUGH_VISITS, ENOUGH_VISITS.replace(">", ">=")),
        ("half a window for anchors", ENOUGH_VISITS, ENOUGH_VISITS + " * 0.5"),
        ("masked opacities count", "statistics.opacity * mask", "statistics.opacity"),
        ("mean opacity of children", "* mask).sum(axis=1)", "* mask).mean(axis=1)"),
        ("best opacity of children", "* mask).sum(axis=1)", "* mask).max(axis=1)"),
        (
            "least opacity of the window",
            "(total < preset.min_opacity * statistics.visits)",
            "(total < preset.min_opacity)",
        ),
        ("<= for < the least opacity", "total < preset", "total <= preset"),
        ("children by the window's opacity", "* statistics.visits[:, None]", ""),
        ("scales are not clamped", "MAX_LOG_SCALE = 0.05", "MAX_LOG_SCALE = np.inf"),
        ("scales are clamped at 0.05", "MAX_LOG_SCALE = 0.05", "MAX_LOG_SCALE = np.log(0.05)"),
    ),
    "training.trainer": (
        ("the rate of l for s", '"log_s": "lr_s"', '"log_s": "lr_l"'),
        ("the rate of psi_s for psi_r", '"psi_r": "lr_r"', '"psi_r": "lr_psi_s"'),
        ("the rate of psi_q for psi_p", '"psi_p": "lr_p"', '"psi_p": "lr_q"'),
        ("the rate of psi_alpha for x", '"x_a": "lr_x"', '"x_a": "lr_alpha"'),
        ("the rate of f for O", '"O_a": "lr_O"', '"O_a": "lr_f"'),
        ("psi_d learns in stage 2", '"psi_d": 3', '"psi_d": 2'),
        ("the grid learns in stage 3", '"grid": 4', '"grid": 3'),
        ("positions move in stage 4", ' or name == "x_a" and self.stage == 4', ""),
        ("statistics from the first step", "self.iteration >= self.preset.collect_from", "True"),
        (
            "statistics one step late",
            "self.iteration >= self.preset.collect_from",
            "self.iteration > self.preset.collect_from",
        ),
        (
            "grows one step late",
            "self.iteration % self.preset.grow_every",
            "(self.iteration - 1) % self.preset.grow_every",
        ),
        ("grows on grow_from", "preset.grow_from < now", "preset.grow_from <= now"),
        ("grows on grow_until", "now < preset.grow_until", "now <= preset.grow_until"),
        ("dead anchors stay", "self.keep_rows(~dead, added)", "self.keep_rows(dead | True, added)"),
        ("reach is clamped for scale", 'self.parameters["log_s"]', 'self.parameters["log_l"]'),
        (
            "scales are clamped where nothing grows",
            'if preset.grow != "scaffold":',
            'log_s = self.parameters["log_s"]\n'
            "        np.minimum(log_s, density.MAX_LOG_SCALE, out=log_s)\n"
            '        if preset.grow != "scaffold":',
        ),
        ("sums are cleared always", "elif growing or now >=", "elif True or now >="),
        (
            "children of new anchors are masked",
            "np.ones((count, self.design.k)",
            "np.zeros((count, self.design.k)",
        ),
        ("moments of new anchors are one", "np.zeros_like(rows)", "np.ones_like(rows)"),
    ),
    "training.initial": (
        ("the step of l for s", "preset.Q_s, preset.Q_l", "preset.Q_l, preset.Q_l"),
    ),
    "training.parameters": (
        ("beta 2 is 0.99", "0.9, 0.999, 1e-15", "0.9, 0.99, 1e-15"),
        ("epsilon is 1e-8", "0.9, 0.999, 1e-15", "0.9, 0.999, 1e-8"),
        ("the schedule starts at 0", SCHEDULE, "step / max(until, 1)"),
        ("the schedule ends late", SCHEDULE, "(step - start) / max(until, 1)"),
        (
            "a linear schedule",
            "np.exp((1 - share) * np.log(first) + share * np.log(last))",
            "(1 - share) * first + share * last",
        ),
    ),
    "training.objective": (
        ("the slope of log s", "s_a_bar * s_a", "s_a_bar"),
        ("no gradient of noise to q", "noise_q_bar + q_bar", "q_bar"),
        ("time from stage 2", "view.time if stage > 2", "view.time if stage > 1"),
    ),
    "equations.step": (("no floor of q", "SMALLEST = 2.0**-10", "SMALLEST = 0.0"),),
    "equations.prior": (("sigma up to e^9", "-14.0, 6.0", "-14.0, 9.0"),),
}
PASSING = {
    "the same number, written otherwise": "no mistake",
    "draws of the levels that are looked at": "no mistake, for given draws",
    "no floor of q": "belongs to step, L1",
    "sigma up to e^9": "belongs to prior, L1",
    "> for >= the threshold": "an exact tie, which the measuring of S would flip",
    "<= for < the least opacity": "an exact tie, which the measuring of S would flip",
}


class Changed(SourceFileLoader):
    """Loads a module with some text replaced."""

    def __init__(self, name, path, old, new):
        super().__init__(name, path)
        self.old, self.new = old, new

    def get_code(self, fullname):
        text = self.get_source(fullname)
        if text.count(self.old) != 1:
            raise ValueError(f"{fullname}: {self.old!r} stands there {text.count(self.old)} times")
        return compile(text.replace(self.old, self.new), self.path, "exec")


@contextmanager
def loaded_with(module, old, new):
    """Load the package and the workshop again, with one change; yield the workshop's loader."""

    class Finder:
        @staticmethod
        def find_spec(name, path=None, target=None):
            spec = PathFinder.find_spec(name, path) if name == module else None
            if spec:
                spec.loader = Changed(name, spec.origin, old, new)
            return spec

    def own():
        return [n for n in sys.modules if n.startswith(("p4dgs_ref", "tests.workshop"))]

    kept = {name: sys.modules.pop(name) for name in own()}
    sys.meta_path.insert(0, Finder)
    try:
        yield lambda name: importlib.import_module(f"tests.workshop.{name}")
    finally:
        sys.meta_path.remove(Finder)
        for name in own():
            del sys.modules[name]
        sys.modules.update(kept)


def noticed_by(module, old, new):
    """Return the id of the first case whose numbers a variant changes, with how; "" for none."""
    with loaded_with(f"p4dgs_ref.{module}", old, new) as load, np.errstate(all="ignore"):
        for key, (file, name) in ANSWERS.items():
            for case in published.cases(key):
                try:
                    outputs, _ = getattr(load(file), name)(**case.inputs())
                except Exception as error:
                    return f"{case.id} {type(error).__name__}: {error}"
                got = published.flatten(outputs, "out.")
                findings = compare(case.tensors, got, case.tolerance("float64"))
                if findings:
                    return f"{case.id} {findings[0].tensor}"
    return ""


def rows():
    """Return (what it does, module, old text, new text) of all variants."""
    return [(says, module, *texts) for module, of in VARIANTS.items() for says, *texts in of]


def main():
    for says, *change in rows():
        found = noticed_by(*change)
        print(f"{says}: {found or 'NOT NOTICED, ' + PASSING.get(says, 'A NEW CASE IS NEEDED')}")


if __name__ == "__main__":
    main()
