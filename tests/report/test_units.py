"""A unit that stands at an axis is that of the numbers along it."""

from p4dgs_ref.report import figures


def test_sizes_are_drawn_in_the_unit_of_their_axis(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, place: drawn.append(figure))
    parts = dict(zip(figures.LABELS, (2000, 500)))
    figures.write_size(
        tmp_path, "a file", {"components": parts, "bytes": 2500, "explicit_bytes": 90_000}
    )
    (ax,) = drawn[0].axes
    assert sorted(bar.get_width() for bar in ax.patches) == sorted(parts.values())
    assert ax.get_xlabel().split()[0] == "bytes", "size.png: its bars are bytes, its axis is not"
