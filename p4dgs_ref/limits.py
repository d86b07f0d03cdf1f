"""How much a model and its file may contain, so that a damaged file costs little time and memory.

The codec's format page states these limits; a port has to keep to them.
"""

MAX_ANCHORS = 2**22
MAX_NUMBERS = 2**25  # in a model; a file may not declare more
MAX_ENTRIES = 2**24  # of the hash grid
MAX_LAYERS, MAX_WIDTH = 8, 2**14  # hidden layers of a network, units of each
MAX_OF = {"d": 4096, "k": 256, "L_x": 64, "L_t": 64, "F": 64}  # fields of a Design, from 1 on
MAX_FILE_BYTES = 2**29  # also of a file of points
MAX_HEADER_BYTES = 2**14  # also of a .ply
