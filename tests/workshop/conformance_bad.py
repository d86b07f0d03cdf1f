"""The bad conformance streams: one defect each; checksums are valid unless they are the defect."""

import json
import struct

import numpy as np

from p4dgs_ref.codec import rans
from p4dgs_ref.codec.container import SECTIONS
from p4dgs_ref.codec.file import sections_of
from p4dgs_ref.codec.gaussian_table import gaussian_model
from p4dgs_ref.codec.streams import encode_gaussian, find_entries
from tests.workshop.conformance_good import Parts
from tests.workshop.damage import framed

ROW, HEAD = 9, 14  # bytes of a row of the section table, and of what stands before it


def rows_of(sections):
    """The rows (id, length, body) of sections."""
    return [
        (i, len(sections[name]), sections[name])
        for i, name in enumerate(SECTIONS, 1)
        if name in sections
    ]


def spliced(body, at, replacement):
    """The bytes with some of them replaced."""
    return body[:at] + replacement + body[at + len(replacement) :]


def forgeries():
    """All bad streams, made from a good one: (name, what is wrong, file, section, offset, kind)."""
    parts = Parts(
        21,
        anchors=6,
        grid=(("xy", 3),),
        hidden=(),
        context=(),
        deformation=(),
        effects=("rotation",),
    )
    parts.mask[...] = True
    # sigma / q = 2 for f, so that features have no raw bits.
    parts.prior(weights=0.0, mu=0.0, raw=[0.0] * 2 + [0.5] * 12)
    parts.steps(0.0, 0.0, 0.0, 0.0)
    symbols = parts.draw(-3, 3, 6, 14)
    symbols[0, 0] = 100  # an escape, the only one of its section
    quantised = parts.quantised(symbols)
    sections = sections_of(quantised)
    return [
        *_frames(sections),
        *_headers(sections),
        *_contents(sections),
        *_streams(sections, quantised),
        _word_given_back(),
        ("unknown_version", "version 3", framed(rows_of(sections), version=3), *_AT_VERSION),
    ]


_AT_VERSION = ("container", 8, "version")


def _frames(sections):
    """Defects of the container."""
    rows = rows_of(sections)
    sound = framed(rows)
    table_end = HEAD + ROW * len(rows)
    flipped, in_table = bytearray(sound), bytearray(sound)
    # A bit of a weight, which only the checksum can reveal, and one of the header's checksum.
    flipped[sound.index(sections["anchor_mlps"]) + 4] ^= 1
    in_table[HEAD + 5] ^= 1
    longer = [(number, length + (number == 2), body) for number, length, body in rows]
    beyond = [*rows[:-1], (12, *rows[-1][1:])]
    return [
        ("truncated", "the last byte is missing", sound[:-1], "container", 10, "length"),
        ("nothing", "a file of no bytes", b"", "container", 0, "length"),
        ("trailing_byte", "one byte too many", sound + b"\0", "container", 10, "length"),
        (
            "counted_trailing_byte",
            "one byte too many that the total length counts",
            framed(rows, tail=b"\0"),
            "container",
            14,
            "length",
        ),
        (
            "wrong_magic",
            "line ends translated from CR LF to LF",
            sound.replace(b"\r\n", b"\n", 1),
            "container",
            0,
            "magic",
        ),
        (
            "wrong_version",
            "version 2",
            framed(rows, version=2),
            *_AT_VERSION,
        ),
        (
            "wrong_total",
            "a total length one too large, its checksum right",
            framed(rows, total=len(sound) + 1),
            "container",
            10,
            "length",
        ),
        (
            "flipped_bit",
            "one bit of a weight in `anchor_mlps`",
            bytes(flipped),
            "anchor_mlps",
            0,
            "checksum",
        ),
        (
            "flipped_table_bit",
            "one bit of the section table",
            bytes(in_table),
            "container",
            table_end,
            "checksum",
        ),
        (
            "swapped_sections",
            "rows and bodies of `positions` and `features` in each other's place",
            framed([rows[0], rows[2], rows[1], *rows[3:]]),
            "container",
            HEAD + 2 * ROW,
            "table",
        ),
        (
            "repeated_section",
            "`positions` twice, no `features`",
            framed([*rows[:2], rows[1], *rows[3:]]),
            "container",
            HEAD + 2 * ROW,
            "table",
        ),
        (
            "unknown_section",
            "id 12",
            framed(beyond),
            "container",
            HEAD + ROW * (len(rows) - 1),
            "table",
        ),
        (
            "section_beyond_the_file",
            "a length one too large",
            framed(longer),
            "container",
            14,
            "length",
        ),
        (
            "missing_section",
            "no `scales`",
            framed([row for row in rows if row[0] != 4]),
            "scales",
            0,
            "missing",
        ),
    ]


def _headers(sections):
    """Defects of the header's content."""
    header = json.loads(sections["header"])

    def changed(bodies=None, **fields):
        body = json.dumps({**header, **fields}, separators=(",", ":")).encode("ascii")
        return framed(rows_of({**sections, "header": body, **(bodies or {})}))

    fewer = {key: value for key, value in header.items() if key != "F"}
    return [
        (
            "absurd_anchors",
            "4194304 anchors, more than a decoder's memory may have to hold",
            changed(anchors=2**22),
            "header",
            0,
            "header",
        ),
        (
            "absurd_grid",
            "18522000 entries of the grid, 2^24 at most",
            changed(grid=[["xyz", 210]], table=[2**24, 64]),
            "header",
            0,
            "header",
        ),
        (
            "absurd_numbers",
            "16000000 entries of the grid, all -1: too many for a file of this size",
            changed({"hash_grid": bytes(4)}, grid=[["xyz", 200]], table=[2**23, 64]),
            "header",
            0,
            "header",
        ),
        (
            "absurd_work",
            "64 levels of 64 entries a node, for more anchors than the time of a decoder allows",
            changed(anchors=9000, grid=[["xyz", 2]] * 64, F=64),
            "header",
            0,
            "header",
        ),
        (
            "unknown_effect",
            "the effect `wind`",
            changed(effects=[*header["effects"], "wind"]),
            "header",
            0,
            "header",
        ),
        (
            "missing_field",
            "no field F",
            framed(rows_of({**sections, "header": json.dumps(fewer).encode()})),
            "header",
            0,
            "header",
        ),
        (
            "no_json",
            "the header ends one byte early",
            framed(rows_of({**sections, "header": sections["header"][:-1]})),
            "header",
            0,
            "header",
        ),
        (
            "one_anchor_more",
            "seven anchors declared, six stored",
            changed(anchors=7),
            "positions",
            60,
            "length",
        ),
        (
            "static_with_deformation",
            "no effect that moves, yet a section `deformation_mlp`, of no bytes",
            changed({"deformation_mlp": b""}, effects=[]),
            "deformation_mlp",
            0,
            "unexpected",
        ),
    ]


def _contents(sections):
    """Defects of numbers that are stored without entropy coding."""
    infinite = spliced(sections["context_mlps"], 6, b"\x00\x7c")
    no_number = spliced(sections["anchor_mlps"], 0, b"\x01\xfe")
    lo, hi = sections["positions"][:12], sections["positions"][12:24]
    bodies = [
        (
            "infinite_weight",
            "the fourth number of `context_mlps` is infinite",
            "context_mlps",
            infinite,
            6,
            "number",
        ),
        (
            "no_number_weight",
            "the first number of `anchor_mlps` is a NaN",
            "anchor_mlps",
            no_number,
            0,
            "number",
        ),
        (
            "box_upside_down",
            "lo and hi exchanged",
            "positions",
            hi + lo + sections["positions"][24:],
            0,
            "number",
        ),
        (
            "box_too_far",
            "a coordinate that is the float32 next to 1e30, which is larger than 1e30",
            "positions",
            spliced(sections["positions"], 12, struct.pack("<f", 1e30)),
            0,
            "number",
        ),
        (
            "weights_short",
            "`anchor_mlps` lacks its last number",
            "anchor_mlps",
            sections["anchor_mlps"][:-2],
            len(sections["anchor_mlps"]) - 2,
            "length",
        ),
        (
            "improbable_masks",
            "a probability of (2^24 + 1) / 2^24",
            "masks",
            (2**24 + 1).to_bytes(4, "little"),
            0,
            "stream",
        ),
        (
            "masks_left_over",
            "a byte behind a stream of equal bits",
            "masks",
            sections["masks"] + b"\0",
            4,
            "stream",
        ),
    ]
    return [
        (name, says, framed(rows_of({**sections, section: body})), section, offset, kind)
        for name, says, section, body, offset, kind in bodies
    ]


def _streams(sections, quantised):
    """Defects of entropy-coded messages."""
    features, scales = sections["features"], sections["scales"]
    message = features[:-2]  # without the escape's gamma code of thirteen bits
    ctx = quantised.context
    offsets = [a[:, 8:].ravel() for a in (quantised.symbols, ctx.mu_units, ctx.sigma_units)]

    def started_high(states, starts, freqs):
        return rans.push_rows_plainly([states[0], states[1] + 2**31, *states[2:]], starts, freqs)

    # This message ends in a state below 2^32.
    likely = rans.encode(np.ones(12, np.int64), np.array([0, 1, 1 << 24]))
    two_lanes = encode_gaussian(*offsets, lanes=2)
    tail = int.from_bytes(two_lanes[1:5], "little")
    gamma = {
        name: np.packbits(np.array([0] * b + [1] + [0] * b), bitorder="little").tobytes()
        for name, b in (("far", 33), ("endless", 34))
    }
    bodies = [
        ("stream_short", "`scales` lacks its last byte", "scales", scales[:-1], None),
        ("stream_long", "a zero byte behind `scales`", "scales", scales + b"\0", None),
        (
            "fill_bits",
            "a one among the bits that fill the last byte",
            "features",
            features[:-1] + bytes([features[-1] | 128]),
            None,
        ),
        (
            "final_state",
            "the state begins with another bit 24, so it does not end at 2^31",
            "features",
            spliced(features, 4, bytes([features[4] ^ 1])),
            None,
        ),
        (
            "state_too_small",
            "a state of 2^31 - 1",
            "scales",
            spliced(scales, 1, b"\xff\xff\xff\x7f" + bytes(4)),
            1,
        ),
        (
            "idle_high_word",
            "a high word of the state, and it is zero",
            "masks",
            (2**24 - 1).to_bytes(4, "little") + b"\x80" + likely[1:] + bytes(4),
            5,
        ),
        (
            "too_many_lanes",
            "2^11 lanes",
            "offsets",
            bytes([two_lanes[0] & 0x80 | 11]) + two_lanes[1:],
            0,
        ),
        (
            "lane_byte",
            "a bit of the lane byte that is not in use",
            "offsets",
            bytes([two_lanes[0] | 16]) + two_lanes[1:],
            0,
        ),
        (
            "lane_count",
            "two lanes declared as four",
            "offsets",
            bytes([two_lanes[0] + 1]) + two_lanes[1:],
            None,
        ),
        (
            "uneven_rows",
            "a tail that leaves an odd number of symbols to two lanes",
            "offsets",
            spliced(two_lanes, 1, (tail + 1).to_bytes(4, "little")),
            1,
        ),
        (
            "long_tail",
            "a tail longer than the message",
            "offsets",
            spliced(two_lanes, 1, (38).to_bytes(4, "little")),
            1,
        ),
        (
            "lane_start",
            "a lane that does not end where lanes start",
            "offsets",
            encode_gaussian(*offsets, lanes=2, push_rows=started_high),
            None,
        ),
        ("far_symbol", "an escape beyond 2^31", "features", message + gamma["far"], None),
        ("endless_escape", "an escape of 34 bits", "features", message + gamma["endless"], None),
    ]
    return [
        (name, says, framed(rows_of({**sections, section: body})), section, offset, "stream")
        for name, says, section, body, offset in bodies
    ]


def _word_given_back():
    """A message of two lanes whose tail leaves the word that lane 0 got back from lane 1.

    A decoder that counts this word with those that it has not read steps four bytes back, into the
    message, and finds there the 32 raw bits that the symbols need.
    """
    parts = Parts(25, anchors=8, d=4, hidden=(), context=(), deformation=(), effects=())
    # sigma / q = 33 for f: one raw bit for each of 32 symbols.
    parts.prior(weights=0.0, mu=0.0, raw=2.8125)
    parts.steps(0.0, 0.0, 0.0, 0.0)
    quantised = parts.quantised()
    ctx = quantised.context
    symbols, *units = (a[:, :4].ravel() for a in (quantised.symbols, ctx.mu_units, ctx.sigma_units))
    model = gaussian_model(*units)
    entries, _ = find_entries(symbols, model)
    starts, freqs = model.keys[entries] & rans.SLOT, np.diff(model.keys)[entries]
    x, stack, tail = rans.LOWEST, [0x89ABCDEF], 2  # a word before the first symbol
    for start, freq in zip(starts[: -tail - 1 : -1].tolist(), freqs[: -tail - 1 : -1].tolist()):
        x = (x // freq << rans.PRECISION) + x % freq + start
    states = rans.start_lanes(x, 2, stack)
    states, row_words = rans.push_rows_plainly(states, starts[:-tail], freqs[:-tail])
    x, top = rans.close_lanes(states)
    words = np.concatenate([np.array(part, "<u4") for part in (top[::-1], row_words, stack)])
    features = b"\x81" + tail.to_bytes(4, "little") + x.to_bytes(8, "little") + words.tobytes()
    return (
        "word_given_back",
        "the tail leaves a word that a lane gave back: the message would end before its last word",
        framed(rows_of({**sections_of(quantised), "features": features})),
        "features",
        None,
        "stream",
    )
