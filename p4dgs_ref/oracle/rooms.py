"""Names the part of a training that is to blame where steps diverge: the first with a wrong number.

A step computes its losses, their gradients and the step of Adam. Every `grow_every` steps density
control follows, and stage 4 begins by putting the positions on their lattice. The cases of `trace`
and `training` hold losses of every step, and the state after every step or after the last one.
"""

GRADIENTS, ADAM, RATES = "gradients", "Adam", "learning rates"
DENSITY, LATTICE = "density control", "lattice"
STEP = f"{GRADIENTS} or {ADAM}"  # where only the losses of the next step are wrong
COARSE = ADAM, STEP, DENSITY  # of which the states after every step tell more
# The equation to blame for losses. Where L1 and D_SSIM are both wrong, the image is.
LOSSES = {
    "L1 D_SSIM": "compositing",
    "L1": "render_loss",
    "D_SSIM": "ssim",
    "L_render": "render_loss",
    "bits": "rate_loss",
    "L_rate": "rate_loss",
    "L_total": "total_loss",
}
OF_EVERY_STEP = {*LOSSES, "rates", "gradient_norm", "total", "ramp"}
STATISTICS = {"mask", "visits", "seen", "opacity", "gradient"}


def blamed(case, findings):
    """Return the equation or the part of a training that is to blame for the wrong tensors."""
    steps, wrong = len(case.tensors.get("in.views", ())), {}  # wrong: step -> {name: kind}
    for finding in findings:
        _, name, *step = finding.tensor.split(".")
        if steps and finding.kind in ("value", "shape"):
            at = step or (finding.first[:1] if name in OF_EVERY_STEP else ()) or [steps - 1]
            wrong.setdefault(int(at[0]), {})[name] = finding.kind
    return _room(case.record["settings"], wrong) if wrong else case.equation


def _room(settings, wrong):
    """Return what is to blame for what is wrong first in some steps, {step: {name: kind}}."""
    step, names = min(wrong.items())
    iteration, every = settings.get("iteration", 0) + step, settings.get("grow_every", 0)
    begins_stage_4 = settings.get("stage_ends", [0, 0, 0])[2] == iteration > 0
    adjusts = every and (iteration + 1) % every == 0 and step > 0
    lost = next((of for loss, of in LOSSES.items() if names.keys() >= {*loss.split()}), None)
    positions = any("x_a" in others for others in wrong.values())
    moments = any(name.startswith("m_") and f"v_{name[2:]}" in names for name in names)
    rules = (
        (LATTICE, "box" in names or lost and begins_stage_4 and positions),
        # From stage 4 on, the noise of the image has the steps of the grid.
        ("hash_grid", lost and begins_stage_4 and "L1" in names),
        (lost, lost and (begins_stage_4 or step == 0)),
        # Otherwise the state before this step is wrong.
        (DENSITY, lost and every and iteration % every == 0),
        (STEP, lost),
        (RATES, "rates" in names),
        (GRADIENTS, "gradient_norm" in names),
        (DENSITY, adjusts or "shape" in names.values()),
        (GRADIENTS, moments),
        (DENSITY, names.keys() & STATISTICS),
        (ADAM, True),
    )
    return next(room for room, holds in rules if holds)


def shared_by(result):
    """Return what other results have in common with one: the training, or the equation."""
    return "training" if result.subject.startswith(("trac", "train")) else result.equation


def refined(results):
    """Return results in which the losses and rates of `training` speak for `training_steps` too.

    The cases of `..._steps` hold every state, but only the sum of the losses, and neither rates nor
    the gradients of `trace`.
    """
    told = {r.id: r.equation for r in results if r.findings and r.equation not in COARSE}
    return [
        r._replace(equation=told.get(r.id.replace("_steps/", "/"), r.equation)) if r.findings else r
        for r in results
    ]
