"""Mutations that no vector can notice, each with the reason why the mutated code computes the same."""

ORDER_OF_A_SUM = "the order of a sum, or of two factors, is free"
REPLACED = "the stand-in of a culled row: anything finite and not zero does, its results are replaced by zeros"

EQUIVALENT = {
    "view:forward:int:5": "a zero vector is divided by two instead of one",
    "deformation:forward:int:3": "what the encoding remembers is the same array as what it gives",
    "step:forward:gt-gte:1": "differs where the sigmoid is exactly 2^-11: no float64 gives that",
    "hash_grid:backward:swap-arguments:3": ORDER_OF_A_SUM,
    "likelihood:forward:add-sub:2": "-0 bits instead of 0: equal as numbers",
    "anchor_rate:forward:swap-items:1": ORDER_OF_A_SUM,
    "anchor_rate:forward:swap-items:2": ORDER_OF_A_SUM,
    "anchor_rate:forward:swap-items:3": ORDER_OF_A_SUM,
    "hash_rate:entropy:swap-items:1": ORDER_OF_A_SUM,
    "hash_rate:forward:swap-arguments:3": "the entropy of two counts does not know which is which",
    "mlp:backward:gt-gte:1": "a product that `needs_x=False` saves is computed, and not used",
    "gaussian_bin:NARROW:int:2": "between 1/17 and 1/16 both formulas have all their digits",
    "gaussian_bin:narrow_bin:int:11": "three millionths of a term that is 4e-11 at most",
    "gaussian_bin:FAR:float:1": "between 2 and 2.02 sigma both formulas have all their digits",
    "gaussian_bin:_stable:lt-lte:1": "at low = 0 one minus the tails and their difference are the same number",
    "gaussian_bin:_stable:lt-lte:2": "at the border both formulas have all their digits",
    "gaussian_bin:_stable:gt-gte:1": "at the border both formulas have all their digits",
    "gaussian_bin:_stable:swap-items:6": "a bin is in one of the two regimes at most: either may come first",
    "window:WINDOW:sub-add:1": "two more zeros at the end of every row, which no slice reaches",
    "compositing:_alphas:int:5": "above 0 by rounding alone, and what rounds is part of every S",
    "projection:forward:float:4": REPLACED,
    "projection:forward:float:5": REPLACED,
    "projection:forward:float:6": REPLACED,
    "projection:forward:int:13": REPLACED,
    "projection:forward:int:14": REPLACED,
    "projection:forward:int:15": "zeros replace a culled row's conic among the outputs, and its gradient in backward",
    "projection:forward:swap-arguments:6": "clip is the median of its three arguments, whichever comes first",
    "projection:backward:no-transpose:4": "Sigma is symmetric in the domain, so its transpose is itself",
    "projection:backward:swap-arguments:11": "Sigma is symmetric in the domain, so its transpose is itself",
}
