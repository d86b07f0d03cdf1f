"""What is ours, not the paper's: B1 to B3, and the file of version 2.

B1 are networks that pay for their bits, B2 sorted positions of few bits, B3 is more weight for
bodies that move. The paper's rooms know nothing of them. `python -m p4dgs_ref.beyond` prints what
version 2 changes of the file format, README.md says what each part buys.
"""

from ..table import Equation

# Rows as in `p4dgs_ref.table`; the number begins with B.
BEYOND = {
    "weight_bits": Equation(
        "weight_bits",
        "B1",
        "bits = -log2 P(w / step - 1/2 < K < w / step + 1/2), K Laplace of scale b",
        "p4dgs_ref.beyond.weight_bits",
        ("bits",),
        ("w", "step"),
    )
}
