"""What the commands print for people; --json prints the same values."""

from ..messages import number_of
from ..training.presets import FIELDS, PAPER_REAL, PAPER_SYNTHETIC, SOURCES, differences


def quality(m):
    """Return PSNR, also of the object alone if the scene has alpha, and SSIM."""
    if m["ssim"] is None:
        return "not measured: the scene has no test views"
    foreground = "" if m["psnr_fg_db"] is None else f" (object {m['psnr_fg_db']:.2f} dB)"
    return f"PSNR {m['psnr_db']:.2f} dB at {m['size']}{foreground}, SSIM {m['ssim']:.4f}"


def size(m):
    """Return the size of the file beside that of the same Gaussians without compression."""
    return (
        f"file {m['bytes']:,} bytes, {m['ratio']:.1f} times smaller than its Gaussians and "
        f"motion network as float32 ({m['explicit_bytes']:,} bytes); "
        f"{m['ratio_without_sh']:.1f} times if these had no spherical harmonics"
    )


def times(m):
    """Return the times of the decoder and the renderer."""
    return f"decode {m['decode_seconds']:.3f} s, render {m['render_fps']:.0f} frames/s"


def metrics(m, folder):
    """Return the metrics of the main job in a few lines."""
    return (
        f"scene {m['scene']}, preset {m['preset']}, seed {m['seed']}: "
        f"{number_of(m['anchors'], 'anchor')}, {number_of(m['gaussians'], 'Gaussian')}\n"
        f"  decoded file on the test views: {quality(m)}\n"
        f"  and on the training views: PSNR {m['train_psnr_db']:.2f} dB at {m['size']}\n"
        f"  {size(m)}\n"
        f"  train {m['train_seconds']:.1f} s ({m['ms_per_step']:.1f} ms per step), "
        f"encode {m['encode_seconds']:.3f} s, {times(m)}, total {m['seconds']:.1f} s\n"
        f"  report in {folder}"
    )


def evaluation(m, rows):
    """Return one line per view, then the means."""
    width = max(len(row["name"]) for row in rows)
    lines = [f"{row['name']:>{width}}  t {row['time']:.3f}  {quality(row)}" for row in rows]
    return "\n".join([*lines, f"mean of {len(rows)}: {quality(m)}", size(m), times(m)])


BYTES = ("estimate_bytes", "integer_bytes", "payload_bytes", "header_bytes", "bytes")
LEDGER = "{:16} {:>10} {:>10} {:>8} {:>8} {:>8} {:>8} {:>9}"


def ledger(rows, gaps):
    """Return a table of the sections of a file, and why its columns differ."""
    file = {"name": "file", **{key: sum(row[key] for row in rows) for key in BYTES}}
    heads = "section", "entropy", "integers", "payload", "headers", "bytes", "symbols", "bits each"
    columns = "name", *BYTES, "symbols", "bits_per_symbol"
    table = [heads, *([cell(row.get(key)) for key in columns] for row in [*rows, file])]
    lines = [LEDGER.format(*line).rstrip() for line in table]
    lines += ["", "Sizes are in bytes. Why one column differs from the next:"]
    return "\n".join([*lines, *(f"  {name:20} {why}" for name, why in gaps.items())])


def cell(value):
    """Return a value in the table of sections; a part that has no symbols has empty cells."""
    return f"{value:.2f}" if isinstance(value, float) else "" if value is None else str(value)


def setting(value):
    """Return a field of a preset."""
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def preset(one, every_field):
    """Return a preset beside the paper's two: all fields, or those that differ, with a star.

    The last column says where the values of the paper's presets come from.
    """
    changed = [field for field, *_ in differences(one)]
    columns = list(dict.fromkeys((one, PAPER_SYNTHETIC, PAPER_REAL)))
    rows = [["  field", *(p.name for p in columns), "source of the paper presets"]]
    for field in FIELDS:
        if every_field or field in changed:
            values = [setting(getattr(p, field)) for p in columns]
            mark = "* " if field in changed else "  "
            rows.append([mark + field, *values, SOURCES[field]])
    widths = [max(map(len, column)) for column in zip(*rows)]
    title = f"{one.name}: {len(changed)} fields (*) differ from {PAPER_SYNTHETIC.name}"
    return "\n".join([title, *("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)])
