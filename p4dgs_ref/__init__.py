"""P-4DGS in NumPy: the paper equation by equation, trained, compressed to bytes, decoded and rendered.

    import p4dgs_ref as p4
    scene = p4.load_scene("bouncing")
    model = p4.train(scene, preset="tiny", seed=0)
    data = p4.encode(model)
    view = scene.test[0]
    image = p4.decode(data).render(view.camera, view.time)

Names are imported when they are first used, so that a program can set the number of BLAS threads before NumPy loads.
"""

from .lazy import offer

__version__ = "0.1.0"

_HOME = {
    "load_scene": "scenes.dnerf",
    "Scene": "scenes.scene",
    "View": "scenes.scene",
    "SceneError": "scenes.scene",
    "simulate": "scenes.simulator.simulate",
    "Camera": "splatting.camera",
    "look_at": "splatting.camera",
    "SETTINGS": "splatting.settings",
    "train": "training.fit",
    "PRESETS": "training.presets",
    "Model": "model",
    "encode": "codec.file",
    "decode": "codec.file",
    "BitstreamError": "codec.container",
    "evaluate": "studies.evaluate",
    "main_job": "studies.main_job",
    "EQUATIONS": "table",
}
_ROOMS = ("oracle",)  # whole packages among the names
__all__ = sorted([*_HOME, *_ROOMS])
__getattr__, __dir__ = offer(__name__, _HOME, _ROOMS)
