"""What a figure shows: the texts that matplotlib really draws, and which of them overlap."""

import inspect
import sys
from contextlib import contextmanager
from itertools import combinations

import matplotlib
from matplotlib.text import Text

DRAW = inspect.unwrap(Text.draw).__code__


@contextmanager
def with_other_settings():
    """Settings of a program in which a figure is drawn, and which must stay as they are."""
    others = {"text.usetex": True, "font.size": 30, "savefig.format": "pdf", "axes.grid": True}
    with matplotlib.rc_context(others):
        before = dict.copy(matplotlib.rcParams)
        yield
        assert dict.copy(matplotlib.rcParams) == before


def texts(figure):
    """[(text, box in pixels)] of all texts that are drawn."""
    drawn, before = [], sys.getprofile()

    def watch(frame, event, _):
        if event == "call" and frame.f_code is DRAW:
            text, renderer = frame.f_locals["self"], frame.f_locals["renderer"]
            if text.get_visible() and text.get_text().strip():
                drawn.append((text.get_text(), Text.get_window_extent(text, renderer)))

    sys.setprofile(watch)
    try:
        figure.canvas.draw()
    finally:
        sys.setprofile(before)
    return drawn


def overlaps(shown):
    """The pairs of `texts` that cover each other by more than a pixel."""
    return [
        (one, other)
        for (one, a), (other, b) in combinations(shown, 2)
        if a.padded(-1).overlaps(b.padded(-1))
    ]
