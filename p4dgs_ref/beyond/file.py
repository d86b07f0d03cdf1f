"""Version 2 of the file: a smaller frame and header; sorted positions and coded networks.

It has the sections of version 1 in the order of their ids. What is not said here is as there.

FRAME.

    offset      bytes  field
    0           8      magic number, as in version 1
    8           1      version, 2
    9           1      w, the number of bytes of a length, 1 to 4
    10          11 w   for each section id in ascending order, 0 where the file has no such section,
                       otherwise its length in bytes plus 1
    10 + 11 w   4      CRC-32 of all bytes of the file before and after this field
    14 + 11 w   ...    the sections' bytes in the order of their ids, without gaps

The lengths add up to the size of the file, which is at most 2^29 bytes. A reader checks in this
order: the size (at least 18 bytes), magic, version, w, the sum of the lengths, and the checksum.

Worked numbers. The file whose only section is "masks" (id 7) with the bytes 01 02 03 has
14 + 11 + 3 = 28 bytes:

    89 50 34 44 0D 0A 1A 0A  02  01                 magic, version, w
    00 00 00 00 00 00  04  00 00 00 00              a length of 3 for id 7
    0E 09 9B F7                                     CRC-32 of the 21 bytes before and the 3 behind
    01 02 03                                        the section

HEADER. It has two more fields:

    as             the name of a base design
    position_bits  bits of a coordinate of a position (`positions.py`): 1 to 16

`as` and `anchors` must be there. Any other field that is missing has the value of the base design.
The limits of version 1 hold for all values together. The base designs stand at the end of this page
and in `bases.json`. None of them ever changes, but others may join. This encoder takes the one that
gives the shortest header, and of several the first.

Worked numbers. {"as":"tiny","anchors":199,"k":5} stands for the header of version 1 with 199
anchors, five children, and the rest of the base design "tiny"; its positions have 10 bits.

SECTIONS. `positions.py` says what follows the box in the section positions, and `weights.py` what
deformation_mlp, anchor_mlps and context_mlps hold. All other sections are those of version 1. The
anchors stand in the order of their positions. Whatever is said about the float16 numbers of version
1 holds for the numbers of the networks here.

STREAMS. The published streams whose names begin with `coded_` have version 2. Their `header` is the
JSON as it stands in the file, without what the base design says. The kind of an error is `table`
for w, `number` for a level or a symbol of a network out of range, and `stream` for r of the
positions and for a row or column code that is the escape (`coded_escape`). Gaps that add up to too
much are refused at r (`coded_overrun`: byte 24), and a gamma code without an end among the gaps
where their raw bits begin (`coded_endless_gap`: byte 25).

Encoding a decoded model again gives the same bytes if this encoder wrote the file. Besides the
choices of version 1, another encoder may choose the base design, the raw bits of a gap, and the
levels and codes of networks.
"""

import json
import zlib
from dataclasses import replace
from pathlib import Path

from ..codec import file, header, quantise
from ..codec.container import CRC, MAGIC, SECTIONS, require, require_magic
from ..codec.header import in_json, integer
from ..codec.plain import Form
from ..limits import MAX_FILE_BYTES
from ..model import Anchors
from .model import Design, Model
from .networks import default_steps
from .positions import codes_of, read_positions, snap, write_positions
from .weights import read_networks, read_steps, round_networks, write_networks

VERSION = 2
FIXED = len(MAGIC) + 2  # bytes of magic, version and w
# Files name the base designs, so none of them may ever change.
BASES = json.loads(Path(__file__).with_name("bases.json").read_text(encoding="utf-8"))


# --- the frame ------------------------------------------------------------------------------------
def write_container(sections):
    """The file with these sections, {name: bytes} in any order."""
    bodies = [sections[name] for name in SECTIONS if name in sections]
    numbers = [len(sections[name]) + 1 if name in sections else 0 for name in SECTIONS]
    w = (max(numbers).bit_length() + 7) // 8 or 1
    head = b"".join([MAGIC, bytes([VERSION, w]), *(n.to_bytes(w, "little") for n in numbers)])
    return b"".join([head, CRC.pack(zlib.crc32(b"".join([head, *bodies]))), *bodies])


def read_container(data):
    """The sections of a file, {name: memoryview}, after checking every byte."""
    view, rows = memoryview(data), read_table(data, len(data))
    sections = {name: view[start : start + length] for name, start, length in rows}
    at = len(data) - sum(map(len, sections.values())) - CRC.size
    crc = zlib.crc32(view[at + CRC.size :], zlib.crc32(view[:at]))
    require(crc == CRC.unpack_from(data, at)[0], "container", at, "wrong checksum of the file")
    return sections


def layout(data):
    """What every byte of a file belongs to: a list of (name, bytes) whose sum is len(data)."""
    parts = [(name, length) for name, _, length in read_table(data, len(data))]
    table = len(data) - FIXED - sum(length for _, length in parts)
    return [("container_header", FIXED), ("section_table", table), *parts]


def read_table(data, size):
    """The checked lengths: (name, offset in the file, length) of every section.

    `data` are the first bytes, enough for the frame, of a file of `size` bytes.
    """
    require_magic(data, size)
    require(data[8] == VERSION, "container", 8, f"version {data[8]}, expected {VERSION}")
    w = data[9]
    start = FIXED + w * len(SECTIONS) + CRC.size
    require(1 <= w <= 4 and start <= size, "container", 9, f"lengths of {w} bytes, expected 1 to 4")
    rows = []
    for name, at in zip(SECTIONS, range(FIXED, start, w)):
        number = int.from_bytes(data[at : at + w], "little")
        if number:
            rows.append((name, start, number - 1))
            start += number - 1
    require(
        start == size <= MAX_FILE_BYTES,
        "container",
        FIXED,
        f"the lengths of the sections add up to {start} of {size} bytes",
    )
    return rows


# --- the header -----------------------------------------------------------------------------------
def write_header(model):
    """The shortest header that names a base design and the fields that differ from it."""
    fields = json.loads(header.write_header(model))  # with lists, as the bases have them
    return min(
        (
            in_json({"as": name} | {k: v for k, v in fields.items() if base.get(k) != v})
            for name, base in BASES.items()
        ),
        key=len,
    )


def read_header(data):
    """The design, the number of anchors and the background of a header section."""
    fields = header.read_object(data)
    base = fields.pop("as", None)
    header.require_header(base in tuple(BASES), f"field 'as': expected one of {', '.join(BASES)}")
    return header.read_fields({**BASES[base], **fields}, {"position_bits": integer(16)}, Design)


FORM = Form(
    write_header,
    read_header,
    write_positions,
    read_positions,
    round_networks,
    write_networks,
    read_networks,
)


# --- from a model to its file and back ------------------------------------------------------------
def quantised(model):
    """The `Quantised` model: like the paper's `quantise`, with the anchors in the file's order."""
    quantise.check_shapes(model)
    anchors, box = quantise.with_children(model.anchors), quantise.round_box(model.box)
    bits = model.design.position_bits
    x_a = quantise.finite("anchors x_a", anchors.x_a)
    positions, x_a = snap(x_a, *box, bits)
    order = codes_of(positions, box, bits).argsort(kind="stable")
    ordered = Anchors(*(array[order] for array in anchors._replace(x_a=x_a)))
    steps = model.steps or default_steps(model.networks)
    return quantise.quantise(replace(model, anchors=ordered, box=box, steps=steps), FORM)


def encode(model):
    """The file of a model, as bytes. Raises the errors of version 1's `encode`."""
    return write_container(file.sections_of(quantised(model), FORM))


def quantised_of(sections):
    """The quantised model in the sections of a file, of any order."""
    q = file.quantised_of(sections, FORM)
    steps, layers = {}, q.model.design.layers()
    for name, members in file.NETWORK_SECTIONS.items():
        shapes = {member: layers[member] for member in members if member in layers}
        if shapes:
            steps |= read_steps(sections[name], name, shapes)
    return q._replace(model=Model(**vars(q.model), steps=steps))


def decode(data):
    """The model in a file. Raises BitstreamError, which names section and byte."""
    return quantised_of(read_container(data)).model
