"""What the paper takes from 3D Gaussian splatting: from Gaussians and a camera to an image.

Read `loop` first: it renders one Gaussian after the other, forward and backward, in the order in
which one would explain it. It starts from 2D splats; these come from `covariance` (scale and
quaternion to a 3 x 3 matrix), `camera` and `projection` (3D Gaussian to 2D splat).

`covariance`, `projection` and `compositing` are the definitions, and rows of the table of equations
(`table`). Training and rendering run twins of them, which tests compare. `factored` is the twin of
the first two; it keeps the digits of needles, Gaussians that are very long and thin. `compositing`
evaluates every Gaussian at every pixel; its twin `fast` evaluates those that `tiles` lists for each
tile of the image. `render` chains these, and `settings` contains the constants and says what may be
left out.
"""
