"""How much a scene and a file may hold, so that a damaged one costs neither time nor memory.

The codec's format page states the limits of a file; a port has to keep to them.
"""

# Of a scene
FARTHEST = 1e6  # scene units from the origin to a camera or point, along any axis
LEAST_LENS, LARGEST_LENS = 1e-9, 1e9  # pixels of a focal length; of a principal point
LARGEST_JSON = 2**27  # bytes; a view takes about 500

# Of a file
MOST_FILE, MOST_HEADER = 2**29, 2**14  # bytes
MOST_ANCHORS, MOST_ENTRIES = 2**22, 2**24  # entries of the hash grid
LARGEST_BOX = 1e30  # of a coordinate, so that extents are finite in float32
MOST_SYMBOL, MOST_STEPS = 2**31, 2**15 - 1  # magnitudes of a symbol, and of a weight's
