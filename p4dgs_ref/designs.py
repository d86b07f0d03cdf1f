"""The only place that knows both designs: the paper's, and ours where `beyond` is there.

A preset, a model and a file say by themselves which design they have, the file by its version. What
this module offers for both has the paper's functions for the paper's design.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO

from numpy.typing import ArrayLike

from . import effects as fx
from . import table
from .codec import container, file, quantise
from .model import Model
from .scenes.scene import Scene
from .splatting.settings import FAST, Settings
from .training import fit as training
from .training import presets, trainer
from .training.fit import SAVE_EVERY, doubts, lost, warn
from .training.parameters import Parameters
from .training.presets import PAPER_SYNTHETIC, Preset

BODY = "`--set body=true` or a preset that has it, such as tiny_coded (B3)"
VERSION_2 = 2
HAS_OURS = find_spec(f"{__package__}.beyond") is not None


def ours(name) -> Any:
    """A module of `beyond`."""
    return import_module(f".beyond.{name}", __package__)


PRESETS: dict[str, Preset] = presets.PRESETS | (ours("presets").PRESETS if HAS_OURS else {})
# All equations that training may call.
EQUATIONS = table.EQUATIONS | (import_module(".beyond", __package__).BEYOND if HAS_OURS else {})


# --- presets --------------------------------------------------------------------------------------
def is_ours(preset: Preset) -> bool:
    """Whether a preset goes beyond the paper."""
    return type(preset) is not Preset


def choose(preset: str | Preset, changes: Any = None) -> Preset:
    """A preset, or the one of that name, with some fields changed, by `training.presets.choose`."""
    chooser: Callable = ours("presets").choose if HAS_OURS else presets.choose
    return chooser(preset, changes, PRESETS)


def paper_preset(preset: Preset) -> Preset:
    """The preset without what goes beyond the paper."""
    return ours("presets").paper_preset(preset) if is_ours(preset) else preset


def paper_name(preset: Preset) -> str:
    """What the preset without what goes beyond the paper is called beside it."""
    return "the paper's design" + " with k = 1" * (preset.k == 1)


def beyond(preset: Preset) -> list[str]:
    """What goes beyond the paper in a preset, a sentence each."""
    return ours("presets").what_is_ours(preset) if is_ours(preset) else []


# --- training -------------------------------------------------------------------------------------
def trainer_class(preset: Preset) -> type[trainer.Trainer]:
    """The class that trains by a preset."""
    return ours("trainer").Trainer if is_ours(preset) else trainer.Trainer


def trainer_of(scene, preset, *arguments, **options) -> trainer.Trainer:
    """The Trainer of a scene by a preset, before its first step."""
    return trainer_class(preset)(scene, preset, *arguments, **options)


def fit(
    scene: Scene,
    preset: str | Preset,
    seed: int,
    settings: Settings = FAST,
    points: ArrayLike | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    stream: TextIO | None = None,
    save_every: float = SAVE_EVERY,
    **changes: Any,
) -> trainer.Trainer:
    """Do what `train` does without its warnings, and return the Trainer, which has the history."""
    fitting = trainer_of(scene, choose(preset, changes), seed, settings, points)
    training.run(fitting, folder, resume, stream, save_every)
    return fitting


def what_is_lost(fitted: trainer.Trainer) -> str:
    """The warning of `training.fit.lost`, with the remedy that is ours where there is one."""
    helps = (
        HAS_OURS and fx.moves(fitted.scene.effects) and not getattr(fitted.preset, "body", False)
    )
    return lost(fitted, BODY if helps else "")


def train(
    scene: Scene,
    preset: str | Preset = "tiny",
    seed: int = 0,
    *,
    settings: Settings = FAST,
    points: ArrayLike | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    stream: TextIO | None = None,
    save_every: float = SAVE_EVERY,
    **changes: Any,
) -> Model:
    """Fit a scene and return the model, ready to be rendered or encoded.

    `preset` is a preset or its name; further keywords change its fields. Anchors start at `points`
    [A, 3] in scene units, without them at those of the scene, and at random where it has none. In
    `folder`, which must exist, a checkpoint is kept and renewed every `save_every` seconds; with
    `resume` training goes on from it. The progress line goes to `stream`.

    Raises ValueError for an unknown preset, field or value, RunError for a checkpoint that does not
    fit, OutputError for a folder in which another training runs or has run, and NotFinite with the
    first equation, array and index that is NaN or infinite. Ctrl-C, SIGTERM or SIGHUP raise
    KeyboardInterrupt after the current iteration, a second one at once. Warns of a scene with few
    training views, of pictures and starting points that are of no use, and where what moves is
    hardly better than in the mean of the training pictures.
    """
    preset = choose(preset, changes)
    for sentence in doubts(scene, preset, seed, points):
        warn(sentence)
    fitted = fit(scene, preset, seed, settings, points, folder, resume, stream, save_every)
    warn(what_is_lost(fitted))
    return fitted.model()


def load_model(folder: str | Path) -> tuple[Model, dict]:
    """The model in the checkpoint of a run folder, and the values of the checkpoint."""
    arrays, values = training.load_checkpoint(folder)
    fields = {
        name.removeprefix("preset."): value
        for name, value in values.items()
        if name.startswith("preset.") and name != "preset.name"
    }
    preset = choose(PAPER_SYNTHETIC, fields)
    kind = trainer_class(preset)
    design, p = kind.design_of(preset, values["effects"]), Parameters(trainer.tagged(arrays, "p"))
    box = tuple(arrays["box"])
    return kind.assemble(p, design, arrays["mask"], box, values["background"]), values


# --- files ----------------------------------------------------------------------------------------
def encode(model: Model) -> bytes:
    """The file of a model, as bytes. The same model gives the same bytes.

    Raises EncodeError or OverflowError for a number that the format cannot hold.
    """
    return (file if type(model) is Model else ours("file")).encode(model)


def decode(data: bytes) -> Model:
    """The model in a file, bit for bit the one that `quantise` made of the encoded model.

    Raises BitstreamError, which names section and byte, for a file that is damaged or inconsistent.
    """
    return (ours("file") if has_version_2(data) else file).decode(data)


def has_version_2(data: bytes) -> bool:
    """Whether a file has the version that is ours."""
    return HAS_OURS and data[8:9] == bytes([VERSION_2])


def read_container(data: bytes) -> dict[str, bytes]:
    """The sections of a file, {name: bytes} in its order, after checking every byte.

    Raises BitstreamError whose `section` is "container" or the section with a wrong checksum.
    """
    views = (ours("file") if has_version_2(data) else container).read_container(data)
    return {name: bytes(body) for name, body in views.items()}


def layout(data: bytes) -> list[tuple[str, int]]:
    """What every byte of a file belongs to: a list of (name, bytes) whose sum is len(data)."""
    return (ours("file") if has_version_2(data) else container).layout(data)


def read_file(path: str | Path) -> bytes:
    """The bytes of a file, which are read only after its frame was checked.

    Raises BitstreamError for a wrong frame, and OSError.
    """

    def check(start, size):
        (ours("file") if has_version_2(start) else container).read_table(start, size)

    return container.read_file(path, check)


def quantised_of(data: bytes) -> quantise.Quantised:
    """The `Quantised` model in a file. Raises BitstreamError, which names section and byte."""
    frame, sections = (ours("file"),) * 2 if has_version_2(data) else (container, file)
    return sections.quantised_of(frame.read_container(data))
