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


def test_rate_and_psnr_are_drawn_in_the_units_of_their_axes(tmp_path, monkeypatch):
    """The columns of training.csv are in dB and in bits per coded number."""
    drawn = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, place: drawn.append(figure))
    row = dict.fromkeys(figures.COLUMNS, 1) | {"stage": 4, "psnr_db": 20, "bits_per_parameter": 5}
    figures.write_training(tmp_path, [[*row.values()]], (0, 0, 0, 2))
    top, bottom = drawn[0].axes
    assert [top.lines[0].get_ydata()[0], bottom.lines[0].get_ydata()[0]] == [20, 5]
    assert "(dB)" in top.get_ylabel(), "training.png: the unit of PSNR"
    assert "(bits per coded number)" in bottom.get_ylabel(), "training.png: the unit of L_rate"
