"""P-4DGS in NumPy: the paper equation by equation, trained, compressed to bytes, decoded, rendered.

    import p4dgs_ref as p4
    p4.prepare()
    scene = p4.load_scene("bouncing")
    model = p4.train(scene, preset="tiny", seed=0)
    data = p4.encode(model)
    view = scene.test[0]
    image = p4.decode(data).render(view.camera, view.time)

Each name is imported when it is first used. A program can therefore call `prepare` after importing
this package and before NumPy loads.
"""

from importlib import import_module

TYPE_CHECKING = False  # type checkers know the name; importing it from typing takes 10 ms
if TYPE_CHECKING:
    from typing import Any

    from . import oracle
    from .arithmetic import prepare
    from .codec.container import BitstreamError
    from .codec.file import decode, encode
    from .model import Model
    from .report.evaluate import evaluate
    from .report.jobs import main_job
    from .scenes import Scene, SceneError, View, load_scene
    from .scenes.simulator import simulate
    from .splatting.camera import Camera, look_at
    from .splatting.settings import SETTINGS
    from .splatting.table import EQUATIONS
    from .training.fit import train
    from .training.presets import PRESETS

__version__ = "0.1.0"

__all__ = [
    "EQUATIONS",
    "PRESETS",
    "SETTINGS",
    "BitstreamError",
    "Camera",
    "Model",
    "Scene",
    "SceneError",
    "View",
    "decode",
    "encode",
    "evaluate",
    "load_scene",
    "look_at",
    "main_job",
    "oracle",
    "prepare",
    "simulate",
    "train",
]

_HOME = {
    "EQUATIONS": "splatting.table",
    "PRESETS": "training.presets",
    "SETTINGS": "splatting.settings",
    "BitstreamError": "codec.container",
    "Camera": "splatting.camera",
    "Model": "model",
    "Scene": "scenes.scene",
    "SceneError": "scenes",
    "View": "scenes.scene",
    "decode": "codec.file",
    "encode": "codec.file",
    "evaluate": "report.evaluate",
    "load_scene": "scenes.load",
    "look_at": "splatting.camera",
    "main_job": "report.jobs",
    "prepare": "arithmetic",
    "simulate": "scenes.simulator",
    "train": "training.fit",
}


def __getattr__(name: str) -> "Any":
    """A name of `__all__`, from the module that defines it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"{__name__}.{_HOME.get(name, name)}")
    return getattr(module, name) if name in _HOME else module


def __dir__() -> list[str]:
    """The names of the module and those that `__getattr__` imports."""
    return sorted({*globals(), *__all__})
