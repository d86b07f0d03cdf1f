"""How much a scene, a model and a file may hold, so that a damaged one costs no time and no memory.

A message holds at most MAX_MESSAGE characters, whatever it quotes.

The codec's format page states the limits of a file; a port has to keep to them.
"""

# Scenes.
MAX_COORDINATE = 1e6  # scene units from the origin to a camera or point, along any axis
MIN_LENS, MAX_LENS = 1e-9, 1e9  # pixels of a focal length; of a principal point
MAX_JSON_BYTES = 2**27  # a view takes about 500
MAX_PICTURE = 2**27  # pixels times channels of a picture

# Models and their files.
MAX_ANCHORS = 2**22
MAX_NUMBERS = 2**25  # of a model; a file may not declare more
MAX_ENTRIES = 2**24  # of the hash grid
MAX_LAYERS, MAX_WIDTH = 8, 2**14  # hidden layers of a network, units of each
MAX_OF = {"d": 4096, "k": 256, "L_x": 64, "L_t": 64, "F": 64}  # fields of a Design, from 1 on
MAX_BOX = 1e30  # of a coordinate, so that extents are finite in float32
MAX_SYMBOL = 2**31  # magnitude of a coded number
MAX_STEPS = 2**15 - 1  # magnitude of a weight that is coded in steps
MAX_FILE_BYTES = 2**29  # also of a file of points
MAX_HEADER_BYTES = 2**14  # also of a .ply
MAX_CHECKPOINT_BYTES = 2**30  # a model, the two moments of each number, and statistics

# Answers of a port.
MAX_ANSWER_BYTES, MAX_ANSWER_HEADER_BYTES = 2**28, 2**20  # of a file
MAX_LINE_BYTES = 2**26  # of an answer by a process

# The classroom.
MAX_STUDENT_BYTES = 200_000  # of a file that is handed in; the longest of the key has 6,000

MAX_MESSAGE = 1000


def cut(text):
    """The text without its middle where it is longer than a message may be."""
    half = MAX_MESSAGE // 2
    return text if len(text) <= MAX_MESSAGE else f"{text[:half]} ... {text[-half:]}"
