"""What the commands print for people; the same values as their --json."""


def quality(m):
    """PSNR, of the object too where the scene has an alpha, and SSIM; equal images have `inf` dB."""
    foreground = "" if m["psnr_fg_db"] is None else f" (object {m['psnr_fg_db']:.2f} dB)"
    return f"PSNR {m['psnr_db']:.2f} dB{foreground}, SSIM {m['ssim']:.4f}"


def size(m):
    """The file beside the same Gaussians without compression."""
    return (
        f"file {m['bytes']:,} bytes; the same Gaussians as float32 {m['explicit_bytes']:,} "
        f"({m['ratio']:.1f} times as many; {m['ratio_without_sh']:.1f} without SH)"
    )


def times(m):
    """How long the coder and the renderer took."""
    encode = (
        "not by this encoder" if m["encode_seconds"] is None else f"{m['encode_seconds']:.3f} s"
    )
    return (
        f"encode {encode}, decode {m['decode_seconds']:.3f} s, "
        f"render {m['render_fps']:.0f} frames/s"
    )


def metrics(m, folder):
    """The main job's metrics in a few lines."""
    return "\n".join(
        [
            f"scene {m['scene']}, preset {m['preset']}, seed {m['seed']}: "
            f"{m['anchors']} anchors, {m['gaussians']} Gaussians",
            f"  decoded file against the test views: {quality(m)}",
            f"  {size(m)}",
            f"  train {m['train_seconds']:.1f} s ({m['ms_per_step']:.1f} ms per step), {times(m)}, "
            f"in all {m['seconds']:.1f} s",
            f"  report in {folder}",
        ]
    )


def evaluation(m, rows):
    """One line a view, then the means."""
    width = max(len(row["name"]) for row in rows)
    lines = [f"{row['name']:>{width}}  t {row['time']:.3f}  {quality(row)}" for row in rows]
    return "\n".join([*lines, f"mean of {len(rows)}: {quality(m)}", size(m), times(m)])


def ledger(rows, gaps):
    """The sections of a file as a table: what they should take, what they take, and why the two differ."""
    total = sum(row["bytes"] for row in rows)
    lines = [
        f"{'section':16} {'entropy':>9} {'integers':>9} {'payload':>8} {'headers':>8} {'bytes':>8} {'share':>7} "
        f"{'symbols':>8} {'bits each':>9}"
    ]
    for row in rows:
        symbols = "" if row["symbols"] is None else row["symbols"]
        each = "" if row["bits_per_symbol"] is None else f"{row['bits_per_symbol']:.3f}"
        lines.append(
            f"{row['name']:16} {row['estimate_bytes']:9.1f} {row['integer_bytes']:9.1f} "
            f"{row['payload_bytes']:8d} {row['header_bytes']:8d} {row['bytes']:8d} "
            f"{100 * row['bytes'] / total:6.1f}% {symbols:>8} {each:>9}"
        )
    sums = [
        sum(row[key] for row in rows)
        for key in ("estimate_bytes", "integer_bytes", "payload_bytes", "header_bytes")
    ]
    lines.append(f"{'file':16} {sums[0]:9.1f} {sums[1]:9.1f} {sums[2]:8d} {sums[3]:8d} {total:8d}")
    lines += ["", "bytes; entropy under the float model, then what the next columns add:"]
    between = {
        "model": "entropy -> integers",
        "coder": "integers -> payload",
        "headers": "payload -> bytes",
    }
    return "\n".join([*lines, *(f"  {between[name]:20} {why}" for name, why in gaps.items())])


def setting(value):
    """A preset's value as --set takes it, tuples with commas; the middle of a long one is left out."""
    if not isinstance(value, tuple):
        return str(value)
    parts = [str(part) for part in value]
    return ",".join(parts if len(parts) < 6 else [*parts[:2], "...", parts[-1]])


def presets(chosen, paper, differences, every_field):
    """Fields of presets beside the paper's two: all of them, or those that differ; a star marks a difference."""
    blocks = []
    for preset in chosen:
        changed = {field for field, *_ in differences(preset)}
        fields = [
            field
            for field in preset._fields
            if field != "name" and (every_field or field in changed)
        ]
        rows = [
            [
                ("* " if field in changed else "  ") + field,
                *(setting(getattr(p, field)) for p in (preset, *paper)),
            ]
            for field in fields
        ]
        table = [["  field", preset.name, *(p.name for p in paper)], *rows] if rows else []
        widths = [max(map(len, column)) for column in zip(*table)]
        head = (
            f"{len(changed)} fields differ from {paper[0].name}"
            if changed
            else "the paper's values"
        )
        blocks.append(
            "\n".join(
                [f"{preset.name}: {head}"]
                + [
                    "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()
                    for row in table
                ]
            )
        )
    return "\n\n".join(blocks)
