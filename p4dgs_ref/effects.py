"""What each effect of the closed list switches on in the model; what is off owns nothing and is never called."""

MOTION = ("translation", "scaling", "rotation")  # the heads of psi_d, in the order of its outputs
HEAD_WIDTHS = (3, 3, 4)


def heads(effects):
    """Widths of the three heads of psi_d: zero where the scene does not list the effect."""
    return tuple(width if effect in effects else 0 for effect, width in zip(MOTION, HEAD_WIDTHS))


def moves(effects):
    """Whether anything moves: without it there is no deformation network, no time, no Eqs. (5) and (6)."""
    return any(heads(effects))


def view_width(effects, which):
    """Columns of the view, distance and direction, among a network's inputs; `which` is a view effect's name."""
    return 4 if which in effects else 0
