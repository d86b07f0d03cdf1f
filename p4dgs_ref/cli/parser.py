"""The command line: the table of all commands and their options, and how one is run."""

import argparse
import math
import os
import shlex
import sys
import warnings
from pathlib import Path

from .. import __version__
from . import experiments, job, oracle, school, study
from .base import UsageError, say


class Parser(argparse.ArgumentParser):
    """argparse with its errors in one line."""

    def error(self, message):
        say(f"{message}; `{self.prog} --help` explains")
        sys.exit(2)


def number(kind, low, high, expected):
    """A reader of a number from low to high; `expected` describes it for the user."""

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
    """A reader of an integer."""
    bounds = f"of at least {low}" if high == math.inf else f"in {low} ... {high}"
    return number(int, low, high, f"a whole number {bounds}")


def real(low, high):
    """A reader of a real number."""
    return number(float, low, high, f"a number in {low:g} ... {high:g}")


def color(text):
    """A reader of a background: a name or three numbers, which the scene will check."""
    try:
        return tuple(map(float, text.split(","))) if "," in text else text
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected white, black or r,g,b in 0 ... 1, got {text!r}"
        ) from None


def listed(read):
    """A reader of numbers with commas between them."""
    return lambda text: tuple(read(part) for part in text.split(",") if part.strip())


def fraction(text):
    """A reader of I/N."""
    i, slash, count = text.partition("/")
    if not slash or not (i + count).isdecimal():
        raise argparse.ArgumentTypeError(f"expected I/N, like 3/15, got {text!r}")
    return int(i), int(count)


def place(text):
    """A reader of a path. An empty one is refused, since it would mean the current folder."""
    if not text:
        raise argparse.ArgumentTypeError("expected a path, got nothing")
    return text


def option(*names, **settings):
    """An argument of a command, in the words of argparse's `add_argument`."""
    return names, settings


def switch(name, help):
    """An option without a value."""
    return option(name, action="store_true", help=help)


def several(name, metavar, help, **settings):
    """An option that may be repeated."""
    return option(name, action="append", default=[], metavar=metavar, help=help, **settings)


def output(help, **settings):
    """The option -o."""
    return option("-o", "--output", metavar="PATH", type=place, help=help, **settings)


JSON = switch("--json", "print JSON instead of text")
QUIET = switch("--quiet", "no progress line")
JOBS = option(
    "--jobs",
    type=whole(1),
    default=os.cpu_count() or 1,
    metavar="N",
    help="processes for independent trainings (default: one for every core); times are never "
    "taken beside them, and the results do not depend on it",
)
CHECK_FINITE = switch(
    "--check-finite",
    "stop at the first equation that makes a NaN or an infinity (training always does)",
)
FILE = option("file", help="a .p4dgs file")
NEW_FOLDER = output("folder to write to", required=True)
VIEW = (
    option(
        "--background", type=color, default="white", help="white, black or r,g,b (default white)"
    ),
    option(
        "--downscale", type=whole(1), default=1, help="divide the image size by this (default 1)"
    ),
)
SCENE_HELP = "a D-NeRF, HyperNeRF or NeRF-DS folder, or the name of a packaged scene"
SCENE = (option("scene", help=SCENE_HELP), *VIEW)
SETTINGS = (
    option("--seed", type=whole(0), default=0, help="seed of everything random (default 0)"),
    several("--set", "KEY=VALUE", "change a field of the preset; may be repeated", dest="changes"),
    QUIET,
    switch("--yes", "go on although the estimate is over an hour"),
)
TRAINING = (
    option("--preset", default="tiny", help="settings of the training (default tiny)"),
    *SETTINGS,
)
SPLIT = option(
    "--split",
    default="test",
    choices=("train", "test", "val"),
    help="which views of the scene (default test)",
)
CAPS = option(
    "--caps",
    type=listed(whole(1)),
    default=(),
    metavar="N,N",
    help="also train every baseline with these numbers of Gaussians, so that files of equal PSNR "
    "can be compared",
)
LENGTH = option(
    "--iterations", type=whole(4), help="of every training (default those of the preset)"
)
EXPERIMENT = (
    *VIEW,
    option("--seeds", type=whole(1, 1000), default=3, help="seeds 0 to N - 1 (default 3)"),
    LENGTH,
    JOBS,
    QUIET,
)
CAMERA = (  # without defaults, so that an option that does not apply can be refused
    option("--azimuth", type=real(-360, 360), help="degrees about z (default 40)"),
    option("--elevation", type=real(-89, 89), help="degrees (default 30)"),
    option("--distance", type=real(1e-3, 1e6), help="from the middle of the anchors (default 3.6)"),
    option("--fov", type=real(1, 170), help="horizontal, degrees (default 41)"),
    option("--size", type=whole(1, 4096), help="pixels along each side (default 128)"),
)
# name: (function, help, arguments)
COMMANDS = {
    "demo": (
        job.demo,
        "the main job: fit a scene, compress, decode, render, measure, draw",
        (
            option("scene", nargs="?", default="bouncing", help=SCENE_HELP),
            *VIEW,
            option(
                "--preset",
                default="tiny_coded",
                help="settings of the training (default tiny_coded, which goes beyond the paper; "
                "the paper's design is then trained too, for comparison)",
            ),
            *SETTINGS,
            option(
                "--jobs",
                type=whole(1),
                default=os.cpu_count() or 1,
                metavar="N",
                help="2 or more train both designs at once (default: one for every core)",
            ),
            output("folder of the report (default report)", default="report"),
        ),
    ),
    "simulate": (
        job.simulate,
        "draw the pictures of a scene.json",
        (option("scene", help="a scene.json"), NEW_FOLDER, QUIET),
    ),
    "train": (
        job.train,
        "fit a scene",
        (
            *SCENE,
            *TRAINING,
            option(
                "--points",
                help="start from the points of a .npy or .ply file or of COLMAP's points3D.txt, in "
                "the coordinates of the scene's files",
            ),
            output("run folder", required=True),
            switch("--resume", "go on from the checkpoint in the run folder"),
            option(
                "--save-every",
                type=real(0, 1e6),
                default=20.0,
                metavar="SECONDS",
                help="between checkpoints (default 20)",
            ),
        ),
    ),
    "encode": (
        job.encode,
        "compress a run to a file",
        (option("run", help="run folder of `train`"), output("file to write", required=True)),
    ),
    "decode": (
        job.decode,
        "write the arrays of a file as npz, its settings as JSON",
        (FILE, NEW_FOLDER),
    ),
    "render": (
        job.render,
        "draw pictures of a file, from a held camera over time or from the cameras of a scene",
        (
            FILE,
            NEW_FOLDER,
            *CAMERA,
            *VIEW,
            option("--frames", type=whole(1, 10_000), help="times from 0 to 1 (default 24)"),
            option("--scene", help="use the cameras and times of this scene"),
            SPLIT,
            option("--settings", default="fast", help="exact, paper or fast (default fast)"),
            CHECK_FINITE,
        ),
    ),
    "export-ply": (
        job.export_ply,
        "write a file's Gaussians of one time and view as a PLY file for splat viewers",
        (
            FILE,
            option(
                "--time",
                type=real(0, 1),
                default=0.0,
                metavar="T",
                help="the time to freeze (default 0); of --all-times the first",
            ),
            option(
                "--all-times",
                type=whole(1, 10_000),
                metavar="N",
                help="write N files, of even times from --time to 1, into a folder",
            ),
            option(
                "--camera",
                type=whole(0),
                metavar="I",
                help="freeze view I of --scene, counted from 0, instead of a held camera",
            ),
            option("--scene", help="whose view --camera is (default: what FILE is named after)"),
            SPLIT,
            *CAMERA[:3],
            *VIEW,
            output("file to write, or folder with --all-times (default beside FILE)"),
        ),
    ),
    "evaluate": (
        job.evaluate,
        "score a file on the test views of a scene",
        (
            FILE,
            *SCENE,
            CHECK_FINITE,
            output("folder for the comparison picture and table (optional)"),
        ),
    ),
    "inspect": (
        job.inspect,
        "list the bytes of a file, section by section, beside their entropy",
        (
            FILE,
            output("folder for the table and the picture (optional)"),
            switch("--heat", "also draw the scene in colours that show what its anchors cost"),
            option(
                "--time", type=real(0, 1), default=0.5, help="of the --heat picture (default 0.5)"
            ),
            *CAMERA,
        ),
    ),
    "equations": (job.equations, "the table of equations", ()),
    "presets": (
        job.presets,
        "what each preset changes, beside the paper's values",
        (option("preset", nargs="?", help="show all fields of this one only"),),
    ),
    "bench": (
        job.bench,
        "time the renderer, the parts of a training step and the coder",
        (switch("--quick", "small sizes, a few seconds"),),
    ),
    "accuracy": (
        study.accuracy,
        "what accuracy costs in time and bytes: a table of knobs, with a figure for each",
        (
            several("--only", "NAME", "only this knob or harness; may be repeated"),
            switch("--quick", "small sizes, about a minute instead of ten"),
            JOBS,
            QUIET,
            output(
                "folder of accuracy.md and its figures (default report/accuracy)",
                default="report/accuracy",
            ),
        ),
    ),
    "stability": (
        study.stability,
        "hard cases: the literal formula, ours, the true value, errors; and the stability map",
        (
            option(
                "--only",
                metavar="ID",
                help="only this case, or all cases of a group, like H-R1",
            ),
            QUIET,
            output("folder of the map (default report)", default="report"),
        ),
    ),
    "effects": (
        study.effects,
        "what each effect of a scene costs and is worth, by training with and without it",
        (
            *SCENE,
            QUIET,
            output("folder for the picture and the table (optional)"),
            switch("--suggest", "only say which effects the pictures call for, and why"),
            switch("--apply", "with --suggest: write the list to the scene's scene.json"),
            switch("--full", "all iterations of the preset tiny instead of half"),
            switch("--quick", "the preset smoke: seconds, too few steps to judge PSNR"),
            option("--seed", type=whole(0), default=0, help="seed of the trainings (default 0)"),
            JOBS,
        ),
    ),
    "compare": (
        experiments.compare,
        "the paper's tables 1 and 2 on tiny scenes: P-4DGS and the methods it is compared with",
        (
            option("scenes", nargs="*", help=f"{SCENE_HELP} (default: all packaged that move)"),
            several("--method", "NAME", "only ours and this one; may be repeated", dest="methods"),
            switch("--quick", "one scene, one seed"),
            option(
                "--equal",
                choices=("iterations", "time"),
                default="iterations",
                help="what all methods get the same of (default iterations)",
            ),
            CAPS,
            *EXPERIMENT,
            output("folder to write to (default report/compare)", default="report/compare"),
        ),
    ),
    "sweep": (
        experiments.sweep,
        "rate-distortion: PSNR against estimated and written bytes over lambda_rate",
        (
            option("scene", help=SCENE_HELP),
            option(
                "--lambda-rate",
                type=listed(real(0, 1e18)),
                default=(1e-4, 1e-3, 3e-3, 1e-2, 3e-2),
                metavar="X,X",
                help="values of the preset's field (default 1e-4,1e-3,3e-3,1e-2,3e-2)",
            ),
            several(
                "--method",
                "NAME",
                "also this baseline, or p4dgs_coded; may be repeated",
                dest="methods",
            ),
            CAPS,
            option(
                "--point",
                type=fraction,
                metavar="I/N",
                help="make only point I of all N of this sweep, as one job of an array does",
            ),
            switch("--collect", "make nothing, draw the points that are there"),
            *EXPERIMENT,
            output(
                "folder of the sweep; points that it holds are kept (default report/sweep)",
                default="report/sweep",
            ),
        ),
    ),
    "ablate": (
        experiments.ablate,
        "the paper's table 3: from D3DGS to P-4DGS step by step, then one part left out at a time",
        (
            option("scene", help=SCENE_HELP),
            *EXPERIMENT,
            output("folder to write to (default report/ablate)", default="report/ablate"),
        ),
    ),
    "composition": (
        experiments.composition,
        "the paper's table 4: what a file consists of at a low and at a high rate",
        (
            option("scene", nargs="?", default="bouncing", help=SCENE_HELP),
            *VIEW,
            option(
                "--low", type=real(0, 1e18), default=1e-2, help="lambda_rate of the low rate (0.01)"
            ),
            option(
                "--high",
                type=real(0, 1e18),
                default=1e-4,
                help="lambda_rate of the high rate (default 0.0001)",
            ),
            option("--seed", type=whole(0), default=0, help="seed of the trainings (default 0)"),
            LENGTH,
            JOBS,
            QUIET,
            output("folder to write to (default report/composition)", default="report/composition"),
        ),
    ),
    "classroom": (
        school.classroom,
        "write the equations with bodies removed for students, and the key for their teacher",
        (
            option(
                "folder",
                type=place,
                help="folder to write to; an existing classroom keeps what students wrote",
            ),
            several("--only", "KEY", "only this equation; may be repeated"),
            switch("--backward-only", "leave the forwards as they are"),
        ),
    ),
    "grade": (
        school.grade,
        "points by student and equation, from inputs that the students have not seen; copies of "
        "the package are noticed by their text, and key/README.md says what remains possible",
        (
            option(
                "folders",
                nargs="+",
                metavar="DIR",
                type=place,
                help="what a student handed in: a classroom, or the files of its folder student/",
            ),
            option(
                "--classroom",
                type=place,
                metavar="DIR",
                help="the classroom whose equations are asked for (default the first DIR)",
            ),
            option(
                "--seed",
                type=whole(0),
                help="seed of the inputs; students must not know it (default: drawn and printed)",
            ),
            switch("--reveal", "print expected values, once grading is closed"),
            option(
                "--timeout",
                type=real(0.1, 3600),
                default=5.0,
                metavar="SECONDS",
                help="for one case (default 5)",
            ),
            QUIET,
            output("folder for grades.txt, .json and .csv (optional)"),
        ),
    ),
}
VECTORS = option(
    "--vectors",
    choices=("1.0", "1.1"),
    default="1.1",
    help="version of the vectors (default 1.1): cases that joined later are left out",
)
ORACLE = {
    "list": (oracle.oracle_list, "list all cases and what each of them tests", (VECTORS,)),
    "path": (oracle.oracle_path, "print the folder in which the vectors are installed", ()),
    "export": (
        oracle.oracle_export,
        "write the vectors into a folder",
        (
            option("folder", type=place, help="folder to write to"),
            VECTORS,
            QUIET,
        ),
    ),
    "check": (
        oracle.oracle_check,
        "judge the answers of a port; exit code 0 only if every required case passes",
        (
            option(
                "folder",
                type=place,
                nargs="?",
                help="folder of the port's answers, <subject>.safetensors or .npz",
            ),
            option("--adapter", metavar="CMD", help="command of a port that answers lines of JSON"),
            option(
                "--timeout",
                type=real(0.01, 86400),
                metavar="SECONDS",
                help="time limit of each answer of the adapter, compilation included (default 10)",
            ),
            option(
                "--dtype",
                choices=("float64", "float32"),
                help="precision of the numbers sent to the adapter (default float64); half is not "
                "judged",
            ),
            option(
                "--level",
                action="append",
                default=[],
                choices=("L0", "L1", "L2", "L3", "L4"),
                help="check only this level; may be repeated",
            ),
            several(
                "--only", "NAME", "check only this equation, subject or group; may be repeated"
            ),
            VECTORS,
            option(
                "--strict",
                action="store_true",
                help="fail the cases that are acceptable because the printed formula, with stock "
                "slopes, has fewer digits there",
            ),
            QUIET,
        ),
    ),
}


def parser():
    """The parser of all commands."""
    top = Parser(
        prog="p4dgs-ref",
        description="P-4DGS in NumPy: fit, compress, decode and render tiny moving scenes.",
    )
    top.add_argument("--version", action="version", version=f"p4dgs_ref {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add_commands(commands, COMMANDS)
    actions = commands.add_parser(
        "oracle", help="golden vectors for ports, and the checker that names the wrong equation"
    ).add_subparsers(dest="action", required=True, metavar="ACTION")
    add_commands(actions, ORACLE)
    return top


def add_commands(subparsers, table):
    """Add the commands of a table."""
    for name, (function, help, arguments) in table.items():
        entry = subparsers.add_parser(name, help=help, description=help)
        entry.set_defaults(function=function)
        for names, settings in (JSON, *arguments):
            entry.add_argument(*names, **settings)


def user_errors():
    """The exceptions that mean a user's mistake or a damaged file."""
    from ..codec.container import BitstreamError
    from ..codec.quantise import EncodeError
    from ..lab.school import ClassroomError
    from ..lab.tables.methods import StudyError
    from ..oracle.adapter import AdapterError
    from ..oracle.safetensors import TensorError
    from ..scenes.output import OutputError
    from ..scenes.scene import SceneError
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
        StudyError,
        UsageError,
    )


def how_to_resume(argv, arguments):
    """The end of the message of a stopped command: how to go on, if there is a checkpoint."""
    from ..training.checkpoint import CHECKPOINT

    if arguments.command != "train" or not (Path(arguments.output) / CHECKPOINT).is_file():
        return ""
    again = argv if arguments.resume else [*argv, "--resume"]
    return f"; the last checkpoint is kept, go on with: {shlex.join(['p4dgs-ref', *again])}"


def show_warning(message, *place):
    """Print a warning as one line; the place in the code means nothing to a user."""
    say(f"warning: {message}")


def run(argv, start):
    """Parse and run a command; returns the exit code.

    Exit codes: 0 success, 1 failed training or check, 2 invalid input, 130 interrupted.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # escape characters that the terminal cannot show
            stream.reconfigure(errors="backslashreplace")
    arguments = parser().parse_args(argv)
    arguments.start = start

    def fail(code, message):
        say(message)
        return code

    try:
        with warnings.catch_warnings():
            warnings.showwarning = show_warning
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
