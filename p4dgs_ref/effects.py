"""What each effect of a scene switches on in the model.

An effect that a scene does not list has no parameters, and its equations are never called.
"""

MOTION = ("translation", "scaling", "rotation")  # the heads of psi_d, in the order of its outputs
HEAD_WIDTHS = (3, 3, 4)


def heads(effects):
    """Return the widths of the three heads of psi_d, 0 for an effect that is not listed."""
    return tuple(width if effect in effects else 0 for effect, width in zip(MOTION, HEAD_WIDTHS))


def moves(effects):
    """Return whether anything moves.

    If nothing does, there is no psi_d, no time, and no Eqs. (5) and (6).
    """
    return any(heads(effects))


def view_width(effects, which):
    """Return how many inputs of an anchor network come from the view: 4, or 0 without the effect.

    `which` is "view_color" for psi_c, "view_geometry" for the other anchor networks.
    """
    return 4 if which in effects else 0
