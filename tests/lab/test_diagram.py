"""Diagrams that can be read: no text covers another, and a method has one colour everywhere."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from p4dgs_ref.lab.accuracy import diagram, likelihood, rendering
from p4dgs_ref.lab.accuracy.formulas import FORMULAS
from tests.lab import drawn


@pytest.fixture
def saved(monkeypatch):
    """Figures as they are just before they are written, {file: figure}."""
    figures = {}
    monkeypatch.setattr(diagram, "save_figure", lambda fig, path: figures.update({path.name: fig}))
    yield figures
    for figure in figures.values():
        diagram.pyplot().close(figure)


def crowd(method="stable", n=9):
    """Points so close together that labels at the same side of all of them would overlap."""
    return [
        {"method": method, "knob": f"{i} entries", "ms": 1 + 0.01 * i, "error": 1e-3 * (1 + i)}
        for i in range(n)
    ]


def test_labels_of_close_points_do_not_overlap(saved, tmp_path, monkeypatch):
    rows = crowd() + crowd("literal")
    diagram.work_precision(tmp_path / "crowd.png", rows, title="a crowd")
    assert drawn.overlaps(saved["crowd.png"]) == []
    shown = [text for text, _ in drawn.texts(saved["crowd.png"]) if text.endswith("entries")]
    assert len(shown) > 6  # most of them find a place
    first, second = (drawn.texts(saved["crowd.png"]) for _ in range(2))
    assert [text for text, _ in first] == [text for text, _ in second]
    moved = [np.abs(a.get_points() - b.get_points()).max() for (_, a), (_, b) in zip(first, second)]
    assert max(moved) < 0.5  # pixels: another layout leaves everything where it is
    monkeypatch.setattr(diagram, "place_labels", lambda fig: None)
    diagram.work_precision(tmp_path / "naive.png", rows, title="a crowd")
    assert len(drawn.overlaps(saved["naive.png"])) > 5


def test_quartiles_are_drawn_as_bars():
    rows = [{**row, "ms_low": row["ms"] - 0.1, "ms_high": row["ms"] + 0.2} for row in crowd(n=3)]
    figure, (ax,) = diagram.figure()
    diagram.lines(ax, rows, diagram.TIME)
    ends = [bar.get_segments()[0][:, 0] for bar in ax.collections]
    assert np.allclose(ends, [(row["ms_low"], row["ms_high"]) for row in rows])
    diagram.pyplot().close(figure)


def colours(figure):
    """{label: colour} of the lines in a figure's first panel."""
    ax = figure.axes[0]
    return {
        line.get_label(): to_hex(line.get_color())
        for line in ax.lines
        if not line.get_label().startswith("_")
    }


def test_a_formula_has_one_colour_in_all_diagrams(saved, tmp_path):
    rows = likelihood.timed_rows(50, 1)
    likelihood.draw_times(tmp_path / "times.png", rows)
    axes = (np.array([0.1, 1.0, 10.0]),) * 2
    flat = np.full((3, 3), 1e-9)
    maps = {(name, dtype): (flat, flat) for name in FORMULAS for dtype in likelihood.DTYPES}
    likelihood.draw_curves(tmp_path / "curves.png", *axes, maps)
    times, curves = colours(saved["times.png"]), colours(saved["curves.png"])
    assert times.pop("table, float64") == curves.pop("table, 256 per sigma")
    assert times == curves and len(set(curves.values())) == 5
    assert drawn.overlaps(saved["times.png"]) == drawn.overlaps(saved["curves.png"]) == []


def test_no_two_methods_of_a_family_look_alike():
    for family in diagram.FAMILIES:
        looks = [(style["color"], style["marker"]) for style in map(diagram.STYLES.get, family)]
        assert len(set(looks)) == len({color for color, _ in looks}) == len(family)
    methods = [method for family in diagram.FAMILIES for method in family]
    assert len(set(methods)) == len(methods)


def test_tiles_and_stops_can_be_read(saved, tmp_path):
    combinations = [pair for pair in rendering.grid(False) if pair[0]["footprint"] == "ellipse"]
    rows = []
    for name in rendering.SCENES:
        chosen = [pair for pair in combinations if pair[0]["cut"] == "5e-5"]
        rows += rendering.measure(name, 30, 24, chosen, 1)
    rendering.draw_tiles(tmp_path / "tiles.png", rows)
    assert drawn.overlaps(saved["tiles.png"]) == []
