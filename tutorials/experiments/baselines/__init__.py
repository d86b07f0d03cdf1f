"""The methods that the paper compares itself with, trained by the package's loop and renderer.

    from tutorials.experiments import baselines
    model = baselines.d3dgs.Trainer(scene, baselines.d3dgs.Preset(), seed=0).run()
    sizes = model.save("bouncing.ply")
    model = baselines.decode(Path("bouncing.ply").read_bytes())

The module of a method has its Preset, its model (a subclass of `explicit.Explicit`) and its
Trainer. Its equations are modules of this folder: D1 to D3 belong to D3DGS, H1 to H3 to 4DHexPlane,
G1 to G4 to 4DGS.
"""

import numpy as np

from . import d3dgs, explicit, gaussian4d, hexplane

# The names in comparisons, each with its module and its preset.
METHODS = {
    "d3dgs": (d3dgs, d3dgs.Preset()),
    "d3dgs_small": (d3dgs, d3dgs.SMALL),
    "hexplane": (hexplane, hexplane.Preset()),
    "gaussian4d": (gaussian4d, gaussian4d.Preset()),
}


def decode(data):
    """The model in a PLY file of any method."""
    return model_of(*explicit.read_ply(data))


def model_of(p, values):
    """The model of some Parameters and of what its file says besides."""
    module, _ = METHODS[values["method"]]
    preset, background = module.Preset(**values["form"]), np.array(values["background"])
    return module.Trainer.kind(p, preset, background, values["occlusion"])
