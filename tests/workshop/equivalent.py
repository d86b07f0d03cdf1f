"""Mutations that no vector can notice, each with the reason why the mutated code does the same."""

ORDER = "the order of a sum, or of two factors, is free"
CULLED = (
    "the replacement of a culled row may be anything finite that is not zero, "
    "because its results are replaced by zeros"
)
SYMMETRIC = "Sigma is symmetric in the domain, so its transpose is itself"
BORDER = "at the border both formulas have all their digits"

EQUIVALENT = {
    "view:nonzero:int:2": "a zero vector is divided by two instead of one",
    "step:forward:gt-gte:1": "differs where the sigmoid is exactly 2^-11; no float64 gives that",
    "hash_grid:backward:swap-arguments:3": ORDER,
    "likelihood:NARROW:int:2": "between 1/17 and 1/16 both formulas have all their digits",
    "likelihood:FAR:float:1": "between 2 and 2.02 sigma both formulas have all their digits",
    "likelihood:rate:lt-lte:1": BORDER,
    "likelihood:rate:gt-gte:1": BORDER,
    "likelihood:rate:lt-lte:2": (
        "at low = 0 one minus the tails and their difference are the same number"
    ),
    "likelihood:rate:int:3": "between 0 and 1 sigma both formulas have all their digits",
    "likelihood:slopes:gt-gte:1": BORDER,
    "likelihood:slopes:float:1": "between 0.5 and 0.505 both formulas have all their digits",
    "likelihood:narrow_bin:int:11": "three millionths of a term that is at most 4e-11",
    "hash_rate:forward:swap-arguments:1": "the entropy of two counts is symmetric in them",
    "mlp:backward:gt-gte:1": "a product that `needs_x=False` saves is computed, but not used",
    "projection:forward:swap-arguments:8": ORDER,
    "projection:forward:int:1": CULLED,
    "projection:backward:no-transpose:2": SYMMETRIC,
    "projection:backward:swap-arguments:6": SYMMETRIC,
    "projection:view:float:1": CULLED,
    "projection:view:float:2": CULLED,
    "projection:view:float:3": CULLED,
    "projection:view:swap-arguments:3": "clip is the median of its arguments, in any order",
    "projection:splats:int:2": CULLED,
    "projection:halved:int:1": CULLED,
    "projection:cross:swap-items:5": "n and both products with it change their signs",
    "factored:forward:swap-arguments:8": ORDER,
    "factored:forward:swap-arguments:10": "of n only the squares count",
    "factored:forward:int:10": CULLED,
    "factored:forward:int:11": CULLED,
    "factored:backward:int:1": CULLED,
    "window:WINDOW:sub-add:1": "two more zeros at the end of every row, which no slice reaches",
}
