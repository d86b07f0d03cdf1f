"""The public names and where each is defined; `__init__.py` imports a name when it is used."""

from . import oracle as oracle
from .arithmetic import prepare as prepare
from .codec.container import BitstreamError as BitstreamError
from .codec.file import decode as decode
from .codec.file import encode as encode
from .model import Model as Model
from .report.evaluate import evaluate as evaluate
from .report.jobs import main_job as main_job
from .scenes.fields import SceneError as SceneError
from .scenes.load import load_scene as load_scene
from .scenes.scene import Scene as Scene
from .scenes.scene import View as View
from .scenes.simulator import simulate as simulate
from .splatting.camera import Camera as Camera
from .splatting.camera import look_at as look_at
from .splatting.settings import SETTINGS as SETTINGS
from .splatting.table import EQUATIONS as EQUATIONS
from .training.fit import train as train
from .training.presets import PRESETS as PRESETS
from .version import __version__ as __version__
