"""What the paper takes from 3D Gaussian splatting: from Gaussians and a camera to an image.

Read `loop` first: it renders one Gaussian after the other, forward and backward, in the order in
which one would explain it. It starts from 2D splats; these come from `covariance` (scale and
quaternion to a 3 x 3 matrix), `camera` and `projection` (3D Gaussian to 2D splat).

The same image is computed twice more. `compositing` is the definition: every Gaussian at every
pixel, nothing skipped, as one row of the table of equations. `tiles` and `fast` are what training
uses: lists of Gaussians for each tile of the image. `render` chains everything, and `settings`
holds the constants and says what may be left out.
"""
