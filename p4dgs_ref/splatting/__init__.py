"""What the paper takes from 3D Gaussian splatting: from Gaussians and a camera to an image.

Read `loop` first: it renders one Gaussian after the other, forward and backward, in the order in
which one would explain it. It starts from 2D splats; these come from `covariance` (scale and
quaternion to a 3 x 3 matrix), `camera` and `projection` (3D Gaussian to 2D splat).

`covariance`, `projection` and `compositing` are the definitions, and rows of the table of equations
(`table`). Training and rendering run twins of them, which tests compare: `factored` for the first
two, because needles keep their digits in it, and `tiles` and `fast`, lists of Gaussians for each
tile of the image, for the third, which evaluates every Gaussian at every pixel. `render` chains
them, and `settings` holds the constants and says what may be left out.
"""
