"""What the commands print for people; --json prints the same values."""

from ..training.presets import PAPER_REAL, PAPER_SYNTHETIC, SOURCES, differences


def quality(m):
    """PSNR, also of the object alone where the scene has an alpha, and SSIM."""
    foreground = "" if m["psnr_fg_db"] is None else f" (object {m['psnr_fg_db']:.2f} dB)"
    return f"PSNR {m['psnr_db']:.2f} dB{foreground}, SSIM {m['ssim']:.4f}"


def size(m):
    """The file compared with the same Gaussians without compression."""
    return (
        f"file {m['bytes']:,} bytes, {m['ratio']:.1f} times smaller than its Gaussians as float32 "
        f"({m['explicit_bytes']:,} bytes); "
        f"{m['ratio_without_sh']:.1f} times without spherical harmonics"
    )


def times(m):
    """The times of the coder and the renderer."""
    encode = m["encode_seconds"]
    coded = "not possible with this encoder" if encode is None else f"{encode:.3f} s"
    return (
        f"encode {coded}, decode {m['decode_seconds']:.3f} s, render {m['render_fps']:.0f} frames/s"
    )


def metrics(m, folder):
    """The metrics of the main job in a few lines."""
    at_once = " (two trainings at once)" if m["trained_at_once"] else ""
    return (
        f"scene {m['scene']}, preset {m['preset']}, seed {m['seed']}: "
        f"{m['anchors']} anchors, {m['gaussians']} Gaussians\n"
        f"  decoded file on the test views: {quality(m)}\n"
        f"  {size(m)}\n"
        f"{against_the_paper(m)}"
        f"  train {m['train_seconds']:.1f} s ({m['ms_per_step']:.1f} ms per step), {times(m)}, "
        f"total {m['seconds']:.1f} s{at_once}\n"
        f"  report in {folder}"
    )


def against_the_paper(m):
    """What a preset beyond the paper gains and loses; nothing for the paper's design itself."""
    paper = m["paper_design"]
    if all(m[key] == value for key, value in paper.items()):
        return ""
    return (
        f"  the paper's design: PSNR {paper['psnr_db']:.2f} dB, SSIM {paper['ssim']:.4f}, file "
        f"{paper['bytes']:,} bytes\n"
        f"  against it: {m['psnr_db'] - paper['psnr_db']:+.2f} dB, "
        f"{m['bytes'] / paper['bytes']:.3f} of the bytes\n"
    )


def evaluation(m, rows):
    """One line a view, then the means."""
    width = max(len(row["name"]) for row in rows)
    lines = [f"{row['name']:>{width}}  t {row['time']:.3f}  {quality(row)}" for row in rows]
    return "\n".join([*lines, f"mean of {len(rows)}: {quality(m)}", size(m), times(m)])


LEDGER = "{:16} {:>9} {:>9} {:>8} {:>8} {:>8} {:>7} {:>8} {:>9}"
HEADS = "section entropy integers payload headers bytes share symbols"
BYTES = ("estimate_bytes", "integer_bytes", "payload_bytes", "header_bytes", "bytes")
BETWEEN = {
    "model": "entropy to integers",
    "coder": "integers to payload",
    "headers": "payload to bytes",
}


def ledger(rows, gaps):
    """The sections of a file: bytes by the entropy, bytes in the file, and why they differ."""
    file = {"name": "file", "symbols": None, "bits_per_symbol": None}
    file.update({key: sum(row[key] for row in rows) for key in BYTES})
    lines = [LEDGER.format(*HEADS.split(), "bits each")]
    for row in [*rows, file]:
        estimate, integer, *rest = (row[key] for key in BYTES)
        share = "" if row is file else f"{100 * row['bytes'] / file['bytes']:.1f}%"
        symbols = "" if row["symbols"] is None else row["symbols"]
        each = "" if row["bits_per_symbol"] is None else f"{row['bits_per_symbol']:.3f}"
        cells = f"{estimate:.1f}", f"{integer:.1f}", *rest, share, symbols, each
        lines.append(LEDGER.format(row["name"], *cells).rstrip())
    lines += ["", "In bytes. The columns differ because of:"]
    return "\n".join([*lines, *(f"  {BETWEEN[name]:20} {why}" for name, why in gaps.items())])


def setting(value):
    """A field of a preset as --set takes it; the middle of a long tuple is left out."""
    if not isinstance(value, tuple):
        return str(value)
    parts = [str(part) for part in value]
    return ",".join(parts if len(parts) < 6 else [*parts[:2], "...", parts[-1]])


def presets(chosen, every_field):
    """The presets beside the paper's two: all fields, or those that differ, with a star.

    The last column says where the values of the paper's presets come from.
    """
    paper, blocks = (PAPER_SYNTHETIC, PAPER_REAL), []
    for preset in chosen:
        changed = {field for field, *_ in differences(preset)}
        columns, count = paper, "the paper's values, and where it gives none those of the source"
        if preset not in paper:
            columns = preset, *paper
            count = f"{len(changed)} fields differ from {paper[0].name}; *: ours"
        table = [["  field", *(p.name for p in columns), "source of the paper presets"]]
        for field in preset._fields[1:]:
            if every_field or field in changed:
                star = "* " if field in changed and preset not in paper else "  "
                values = [setting(getattr(p, field)) for p in columns]
                table.append([star + field, *values, SOURCES[field]])
        widths = [max(map(len, column)) for column in zip(*table)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in table]
        blocks.append("\n".join([f"{preset.name}: {count}", *(lines if len(table) > 1 else [])]))
    return "\n\n".join(blocks)
