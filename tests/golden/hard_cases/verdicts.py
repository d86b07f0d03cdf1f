"""What the hard cases that are procedures return."""

from p4dgs_ref.lab.stability.table import Measured


def exact(literal, ours, true, error):
    """The result of a procedure that must be exactly right."""
    return Measured(literal, ours, true, float(error), None, 0.0, None)


def refuses(call, error, says=""):
    """Whether a call raises that error, with a message that contains `says`."""
    try:
        call()
    except error as refusal:
        return says in str(refusal)
    return False
