"""The command line: what each command is called and takes; what it does stands in commands.py."""

import argparse
import math
import os
import shlex
import sys
from pathlib import Path

from .. import __version__
from . import commands


class Parser(argparse.ArgumentParser):
    """argparse with its errors in one line."""

    def error(self, message):
        self.exit(2, f"p4dgs-ref: {message}; `{self.prog} --help` explains\n")


def number(kind, low, high, expected):
    """A reader of an option's number between low and high; `expected` says so in words."""

    def read(text):
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}")
        return value

    return read


def whole(low, high=math.inf):
    """A reader of a whole number."""
    return number(
        int,
        low,
        high,
        f"a whole number of at least {low}"
        if high == math.inf
        else f"a whole number in {low} ... {high}",
    )


def real(low, high):
    """A reader of a number."""
    return number(float, low, high, f"a number in {low:g} ... {high:g}")


def color(text):
    """A reader of a background: a name, or three numbers; the scene checks them."""
    try:
        return tuple(map(float, text.split(","))) if "," in text else text
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected white, black or r,g,b in 0 ... 1, got {text!r}"
        ) from None


def place(text):
    """A path that is not empty: an empty one would mean the current folder by accident."""
    if not text:
        raise argparse.ArgumentTypeError("expected a path, got nothing")
    return text


def add_output(entry, default=None, what="folder to write to"):
    required, default = default is None, default or None  # "" makes it optional
    entry.add_argument(
        "-o", "--output", metavar="PATH", type=place, default=default, required=required, help=what
    )


def add_json(entry):
    entry.add_argument("--json", action="store_true", help="print JSON instead of text")


def add_training(entry):
    entry.add_argument("--preset", default="tiny", help="settings of the training (default tiny)")
    entry.add_argument(
        "--seed", type=whole(0), default=0, help="seed of everything random (default 0)"
    )
    entry.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="changes",
        help="change a field of the preset; may be repeated",
    )
    entry.add_argument("--quiet", action="store_true", help="no progress line")
    entry.add_argument(
        "--yes", action="store_true", help="go on although the estimate is over an hour"
    )


def add_view(entry):
    entry.add_argument(
        "--background", type=color, default="white", help="white, black or r,g,b (default white)"
    )
    entry.add_argument(
        "--downscale", type=whole(1), default=1, help="divide the image size by this (default 1)"
    )


def add_scene(entry, **optional):
    entry.add_argument(
        "scene", help="a folder in the D-NeRF layout, or the name of a packaged scene", **optional
    )
    add_view(entry)


def add_camera(entry):
    """The held camera; its defaults are `commands.CAMERA`, so that an option given in vain can be told from one not given."""
    entry.add_argument("--azimuth", type=real(-360, 360), help="degrees about z (default 40)")
    entry.add_argument("--elevation", type=real(-89, 89), help="degrees (default 30)")
    entry.add_argument(
        "--distance", type=real(1e-3, 1e6), help="from the middle of the anchors (default 3.6)"
    )
    entry.add_argument("--fov", type=real(1, 170), help="horizontal, degrees (default 41)")
    entry.add_argument("--size", type=whole(1, 4096), help="pixels along each side (default 128)")


def parser():
    """All commands and their options."""
    top = Parser(
        prog="p4dgs-ref",
        description="P-4DGS in NumPy: fit, compress, decode and render tiny moving scenes.",
    )
    top.add_argument("--version", action="version", version=f"p4dgs_ref {__version__}")
    sub = top.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)

    def command(name, help, among=sub, prefix=""):
        entry = among.add_parser(name, help=help, description=help)
        entry.set_defaults(function=getattr(commands, prefix + name))
        add_json(entry)
        return entry

    e = command("demo", "the main job: fit a scene, compress, decode, render, measure, draw")
    add_scene(e, nargs="?", default="bouncing"), add_training(e)
    add_output(e, "report", "folder of the report (default report)")
    e = command("simulate", "draw the pictures of a scene.json")
    e.add_argument("scene", help="a scene.json"), add_output(e)
    e.add_argument("--quiet", action="store_true", help="no progress line")
    e = command("train", "fit a scene")
    add_scene(e), add_training(e), add_output(e, None, "run folder")
    e.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint in the run folder"
    )
    e.add_argument(
        "--save-every",
        type=real(0, 1e6),
        default=20.0,
        metavar="SECONDS",
        help="between checkpoints (default 20)",
    )
    e = command("encode", "compress a run to a file")
    e.add_argument("run", help="run folder of `train`"), add_output(e, None, "file to write")
    e = command("decode", "a file's arrays as npz, its settings as JSON")
    e.add_argument("file", help="a .p4dgs file"), add_output(e)
    e = command(
        "render", "pictures of a file, from a held camera over time or from a scene's cameras"
    )
    e.add_argument("file", help="a .p4dgs file"), add_output(e), add_camera(e), add_view(e)
    e.add_argument("--frames", type=whole(1, 10_000), help="times from 0 to 1 (default 24)")
    e.add_argument("--scene", help="render this scene's cameras and times instead of a held camera")
    e.add_argument(
        "--split",
        default="test",
        choices=("train", "test", "val"),
        help="which of the scene's views",
    )
    (
        e.add_argument("--settings", default="fast", help="exact, paper or fast (default fast)"),
        add_check(e),
    )
    e = command("evaluate", "score a file on a scene's test views")
    e.add_argument("file", help="a .p4dgs file"), add_scene(e), add_check(e)
    add_output(e, "", "folder for the comparison picture and table (optional)")
    e = command("inspect", "a file's bytes, section by section, beside their entropy")
    (
        e.add_argument("file", help="a .p4dgs file"),
        add_output(e, "", "folder for the table and the picture (optional)"),
    )
    e.add_argument(
        "--heat",
        action="store_true",
        help="also draw the scene in the colours of what its anchors cost",
    )
    (
        e.add_argument(
            "--time", type=real(0, 1), default=0.5, help="of the --heat picture (default 0.5)"
        ),
        add_camera(e),
    )
    command("equations", "the table of equations")
    e = command("presets", "what each preset changes, beside the paper's values")
    e.add_argument("preset", nargs="?", help="only this one, all fields")
    e = command("bench", "time the renderer, the parts of a training step and the coder")
    e.add_argument("--quick", action="store_true", help="small sizes, a few seconds")
    add_studies(command), add_classroom(command)
    e = sub.add_parser(
        "oracle", help="golden vectors for ports, and the checker that names the wrong equation"
    )
    add_oracle(
        lambda name, help, among=e.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser): (
            command(name, help, among, "oracle_")
        )
    )
    return top


def add_studies(command):
    """What accuracy costs, what hard cases do, what effects are worth."""
    e = command(
        "accuracy", "what accuracy costs in time: studies, each with diagrams, tables and a reading"
    )
    e.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="NAME",
        help="only this study; may be repeated",
    )
    e.add_argument(
        "--quick", action="store_true", help="small sizes, about a minute instead of ten"
    )
    e.add_argument(
        "--summary",
        action="store_true",
        help="only error and time of the settings exact, paper and fast",
    )
    (
        add_quiet(e),
        add_output(
            e, "report/accuracy", "folder of accuracy.md and its figures (default report/accuracy)"
        ),
    )
    e = command(
        "stability", "hard cases: literal formula, ours, true value, errors; and the stability map"
    )
    e.add_argument(
        "--only", metavar="ID", help="only this case, or those of a row of the catalogue, like H-R1"
    )
    add_quiet(e), add_output(e, "report", "folder of the map (default report)")
    e = command(
        "effects", "what each effect of a scene costs and is worth, by training with and without it"
    )
    add_scene(e), add_quiet(e), add_output(e, "", "folder for the picture and the table (optional)")
    e.add_argument(
        "--suggest",
        action="store_true",
        help="only say which effects the pictures call for, and why",
    )
    much = e.add_mutually_exclusive_group()
    much.add_argument(
        "--full", action="store_true", help="all iterations of the preset tiny instead of half"
    )
    much.add_argument(
        "--quick", action="store_true", help="the preset smoke: seconds, no judgement of PSNR"
    )
    e.add_argument("--seed", type=whole(0), default=0, help="seed of the trainings (default 0)")


def add_classroom(command):
    """A copy of the equations for students, and their grades."""
    e = command(
        "classroom",
        "write the equations with bodies removed for students, and the key for their teacher",
    )
    e.add_argument(
        "folder",
        type=place,
        help="folder to write to; one that is a classroom already keeps what students wrote",
    )
    e.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="KEY",
        help="only this equation; may be repeated",
    )
    e.add_argument("--backward-only", action="store_true", help="leave the forwards as they are")
    e.add_argument(
        "--seed",
        type=whole(0),
        help="seed of the held-back inputs by which `grade` judges (default 0)",
    )
    e = command("grade", "points by equation, from inputs that the students have not seen")
    e.add_argument("folder", type=place, help="folder that `classroom` wrote")
    e.add_argument(
        "--student",
        type=place,
        metavar="FOLDER",
        help="files of one student (default FOLDER/student)",
    )
    e.add_argument(
        "--seed", type=whole(0), help="seed of the held-back inputs (default that of the classroom)"
    )
    e.add_argument(
        "--timeout",
        type=real(0.1, 3600),
        default=5.0,
        metavar="SECONDS",
        help="for one case (default 5)",
    )
    add_quiet(e), add_output(e, "", "folder for grades.txt, .json and .csv (optional)")


def add_check(entry):
    entry.add_argument(
        "--check-finite",
        action="store_true",
        help="stop at the first equation that makes a NaN or an infinity (training always does)",
    )


def add_quiet(entry):
    entry.add_argument("--quiet", action="store_true", help="no progress line")


def add_oracle(command):
    """The actions of `oracle`."""
    command("list", "the cases: what each tests")
    command("path", "where the vectors are installed")
    e = command("export", "write the vectors into a folder")
    e.add_argument("folder", type=place, help="folder to write to")
    e.add_argument(
        "--regenerate",
        action="store_true",
        help="compute them anew instead of copying the published ones",
    )
    add_quiet(e)
    e = command("check", "judge a port's answers; exit code 0 only if every required case passes")
    e.add_argument(
        "folder", type=place, nargs="?", help="where the port wrote <subject>.safetensors or .npz"
    )
    e.add_argument(
        "--adapter", metavar="CMD", help="ask this process instead, line by line in JSON"
    )
    e.add_argument(
        "--timeout",
        type=real(0.01, 86400),
        metavar="SECONDS",
        help="for one answer of the adapter (default 10)",
    )
    e.add_argument(
        "--dtype",
        choices=("float64", "float32"),
        help="precision of what the adapter is sent (default float64)",
    )
    e.add_argument(
        "--level",
        action="append",
        default=[],
        choices=("L0", "L1", "L2", "L3", "L4"),
        help="only this level; may be repeated",
    )
    e.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="NAME",
        help="only this equation or subject; may be repeated",
    )
    add_quiet(e)


def user_errors():
    """The exceptions that are a user's mistake or a damaged file, imported late."""
    from ..codec.container import BitstreamError
    from ..codec.quantise import EncodeError
    from ..oracle.adapter import AdapterError
    from ..oracle.safetensors import TensorError
    from ..scenes.output import OutputError
    from ..scenes.scene import SceneError
    from ..school import ClassroomError
    from ..training.checkpoint import RunError

    return (
        BitstreamError,
        EncodeError,
        OutputError,
        SceneError,
        RunError,
        TensorError,
        AdapterError,
        ClassroomError,
        commands.UsageError,
    )


def how_to_resume(argv, arguments):
    """The end of the message after Ctrl-C: the command that goes on, where there is a checkpoint."""
    from ..training.checkpoint import CHECKPOINT

    if arguments.command != "train" or not (Path(arguments.output) / CHECKPOINT).is_file():
        return ""
    again = argv if arguments.resume else [*argv, "--resume"]
    return f"; the last checkpoint is kept, go on with: {shlex.join(['p4dgs-ref', *again])}"


def run(argv, start):
    """Parse and run; returns the exit code: 0 well, 1 training or a check failed, 2 a mistake of the user, 130 stopped."""
    for stream in (
        sys.stdout,
        sys.stderr,
    ):  # what the terminal cannot show must not end the program
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    arguments = parser().parse_args(argv)
    arguments.start = start

    def fail(code, message):
        print(f"p4dgs-ref: {message}", file=sys.stderr)
        return code

    try:
        return arguments.function(arguments) or 0
    except KeyboardInterrupt:
        return fail(130, f"stopped{how_to_resume(argv, arguments)}")
    except user_errors() as error:
        return fail(2, error)
    except OSError as error:
        return fail(2, f"{error.filename or 'output'}: {error.strerror or error}")
    except ArithmeticError as error:
        return fail(1, error)
    except MemoryError as error:
        return fail(1, f"out of memory: {error}")
