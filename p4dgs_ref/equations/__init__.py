"""The paper, one file per equation, listed here in the order of the paper: read them in this order.

Spatial prediction turns anchors into Gaussians: `offsets` (Eq. 1), `view` (2), `mlp`, the network
behind every psi, `anchor_network`, `opacity` (3), `masking`, `color` and `rotation` (3 by analogy),
`scale` (4).

Temporal prediction moves the Gaussians: `positional_encoding`, `deformation` (5), `deformed` (6).

Entropy coding predicts the bits of the anchors: `noise` (7), `step` (8), `grid_nodes` and
`hash_grid` (9), `rounding` (10), `likelihood` (11), `prior` (12), `anchor_rate` (13), `hash_rate`
(14).

The training objective weighs the bits against the error of the image: `total_loss` (15), `window`,
`ssim` and `render_loss` (16), `rate_loss` (17).

`numerics` has the functions whose textbook form loses digits. `table` lists the equations with
their formulas.
"""
