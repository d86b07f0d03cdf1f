"""PLY files of point clouds and of Gaussians: the properties of their vertices."""

import numpy as np

from .scene import require

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
LONGEST = 200  # bytes of a line of a header


def read_vertices(path, needed):
    """The properties of the element `vertex` of a PLY file, {name: values}.

    It must be the first element, as in the files of COLMAP and of 3DGS, and have the properties
    that are `needed`.
    """
    with open(path, "rb") as file:
        lines = [file.readline(LONGEST).split()]
        require(lines[0] == [b"ply"], path, "expected a first line 'ply'")
        while lines[-1] != [b"end_header"]:
            line = file.readline(LONGEST)
            require(
                line and len(lines) < 1000, path, "expected a header that ends with 'end_header'"
            )
            lines.append(line.split())
        body = file.read()
    words = [[word.decode("ascii") for word in line] for line in lines]
    order = next(BYTE_ORDERS[line[1]] for line in words if line[:1] == ["format"])
    starts = [i for i, line in enumerate(words) if line[:1] == ["element"]] + [len(words)]
    require(
        len(starts) > 1 and words[starts[0]][1] == "vertex",
        path,
        "expected 'vertex' as first element",
    )
    count = int(words[starts[0]][2])
    properties = [line for line in words[starts[0] : starts[1]] if line[:1] == ["property"]]
    kinds = [(line[-1], order + PLY_TYPES[line[1]]) for line in properties]
    names = [name for name, _ in kinds]
    for name in needed:
        require(
            name in names, path, f"expected properties {', '.join(needed)} of the element vertex"
        )
    if order:
        vertices = np.frombuffer(body, np.dtype(kinds), count)
        return {name: vertices[name] for name in names}
    rows = [line.split() for line in body.splitlines()[:count]]
    require(len(rows) == count, path, f"expected {count} lines of vertices")
    return {name: np.array([float(row[i]) for row in rows]) for i, name in enumerate(names)}
