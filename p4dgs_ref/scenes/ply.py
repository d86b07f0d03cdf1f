"""PLY files: elements, such as the vertices of a point cloud, with one number for each property."""

from itertools import islice
from pathlib import Path

import numpy as np

from .output import write_atomically
from .scene import require

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
MOST_LINES, LONGEST_LINE = 1000, 2**16  # of a header


def write_ply(path, elements, comments=()):
    """Write float32 numbers as a binary file; returns the bytes of the header and every element.

    `elements` is {name: (names of its properties, rows [N, P])}. A comment is one line of ASCII.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, (properties, rows) in elements.items():
        lines.append(f"element {name} {len(rows)}")
        lines += [f"property float {of_element}" for of_element in properties]
    header = "\n".join([*lines, "end_header\n"]).encode("ascii")
    parts = [header, *(rows.astype("<f4").tobytes() for _, rows in elements.values())]
    write_atomically(Path(path), lambda file: file.write(b"".join(parts)))
    return [len(part) for part in parts]


def read_ply(path, expected=("vertex",)):
    """The first elements of a file, its comments, and the number of bytes that follow.

    `expected` are the names of these elements. An element is a structured array [N], whose fields
    are its properties. COLMAP and 3DGS write `vertex` first.
    """
    with open(path, "rb") as file:
        lines = [file.readline(LONGEST_LINE)]
        require(lines[0].split() == [b"ply"], path, "expected a first line 'ply'")
        while lines[-1].split() != [b"end_header"]:
            lines.append(file.readline(LONGEST_LINE))
            whole = lines[-1] and len(lines) <= MOST_LINES
            require(whole, path, "expected a header that ends with 'end_header'")
        body = file.read()
    words = [line.decode("ascii").split() for line in lines]
    order = next(BYTE_ORDERS[line[1]] for line in words if line[:1] == ["format"])
    starts = [i for i, line in enumerate(words) if line[:1] == ["element"]]
    require(len(starts) >= len(expected), path, f"expected the elements {', '.join(expected)}")
    found, at, rows = {}, 0, iter(() if order else body.splitlines())
    for name, start, end in zip(expected, starts, [*starts[1:], len(words)]):
        require(words[start][1] == name, path, f"expected {name!r}, not {words[start][1]!r}")
        properties = [line for line in words[start:end] if line[:1] == ["property"]]
        types = [order + PLY_TYPES[line[1]] if order else "f8" for line in properties]
        kind = np.dtype([(line[-1], one) for line, one in zip(properties, types)])
        count = int(words[start][2])
        if order:
            found[name] = np.frombuffer(body, kind, count, at)
            at += found[name].nbytes
        else:
            numbers = [tuple(map(float, row.split()[: len(types)])) for row in islice(rows, count)]
            require(len(numbers) == count, path, f"expected {count} lines of the element {name}")
            found[name] = np.array(numbers, kind)
    comments = [line.decode("ascii").strip()[8:] for line in lines if line.startswith(b"comment ")]
    return found, comments, len(body) - at
