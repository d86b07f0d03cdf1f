"""The command line: the table of all commands and their options, and how one is run.

A command is a function in a module of this room. The module is imported when the command runs, so
that `p4dgs-ref --help` is quick and a mistake in an option is reported at once.
"""

import argparse
import sys
import warnings
from contextlib import suppress
from importlib import import_module

from ..arithmetic import arithmetic
from ..signals import deferred
from . import print_message, print_result, print_warning


class Parser(argparse.ArgumentParser):
    """argparse with its errors in one line."""

    def error(self, message):
        print_message(f"{message}; see `{self.prog} --help`")
        sys.exit(2)


KEPT = """Version 1 keeps: format 1 of files, the golden vectors with their tolerances, the names of
`import p4dgs_ref` and of its oracle, the adapter's protocol, commands, the options of the main ones
and exit codes. On x86-64 Linux with AVX2, the same seed and versions give the same bytes; where the
kernels are the processor's own, trained bytes may differ, but files decode to the same numbers.
"What version 1.0 promises" in tutorials/reference.md has the details."""


class Version(argparse.Action):
    """The option --version; NumPy is loaded only for it."""

    def __call__(self, parser, *others):
        print_result(f"{arithmetic()}\n{KEPT}")
        parser.exit()


# --- types of values, as argparse asks for them ---
def number_in_range(kind, low, high=1e18):
    """Return a reader of an integer or a real number from low to high."""

    def read(text):
        with suppress(ValueError):
            if low <= (value := kind(text)) <= high:
                return value
        words = "a whole number" if kind is int else "a number"
        raise argparse.ArgumentTypeError(f"expected {words} from {low:g} to {high:g}, got {text!r}")

    return read


def nonempty_text(text):
    """Return a text unless it is empty: an empty path would stand for the current folder.

    No path contains NUL.
    """
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"expected a non-empty text without NUL, got {text!r}")
    return text


# --- parts of the table ---
def option(*names, type=nonempty_text, **settings):
    """Return an argument of a command with a value, as `add_argument` of argparse takes it."""
    return names, {"type": type, **settings}


def switch(name, help):
    """Return an option without a value."""
    return (name,), {"action": "store_true", "help": help}


def several(name, metavar, help, **settings):
    """Return an option that may be repeated."""
    return option(name, action="append", default=[], metavar=metavar, help=help, **settings)


def output(help, **settings):
    """Return the option -o."""
    return option("-o", "--output", metavar="PATH", help=help, **settings)


JSON = switch("--json", "print JSON instead of text")
YES = switch("--yes", "start long trainings without asking")
FILE = option("file", help="a .p4dgs file")
NEW_FOLDER = output("folder to write to", required=True)
SCENE_HELP = "a folder of pictures with cameras, or the name of a packaged scene"
SCENE = option("scene", help=SCENE_HELP)
DOWNSCALE = option(
    "--downscale",
    type=number_in_range(int, 1),
    default=1,
    metavar="N",
    help="divide both sides of the scene's pictures by N (default 1)",
)
SETTINGS = (
    option("--preset", default="tiny", metavar="NAME", help="listed by `presets` (default tiny)"),
    option(
        "--seed",
        type=number_in_range(int, 0),
        default=0,
        metavar="N",
        help="random seed (default 0)",
    ),
    several("--set", "KEY=VALUE", "change a field of the preset; may be repeated", dest="changes"),
    switch("--quiet", "show no progress"),
    YES,
)
ORACLE = {
    "list": ("oracle.list_cases", "list all cases and what each of them tests", ()),
    "equations": ("oracle.list_equations", "print the table of equations", ()),
    "export": (
        "oracle.export_vectors",
        "copy the vectors into a folder, and print where they are installed",
        (option("folder", help="folder to write to"),),
    ),
    "check": (
        "oracle.check",
        "check the answers of a port; exit code 0 only if every required case passes",
        (
            option(
                "folder",
                nargs="?",
                help="folder with the port's answers, <subject>.safetensors or .npz",
            ),
            JSON,
            option(
                "--adapter", metavar="CMD", help="command that starts a port that answers in JSON"
            ),
            option(
                "--timeout",
                type=number_in_range(float, 0.01, 86400),
                metavar="SECONDS",
                help="time limit for each answer of the adapter, with its compilation (default 10)",
            ),
            option(
                "--dtype",
                choices=("float64", "float32"),
                help="precision of the numbers sent to the adapter (default float64)",
            ),
            several("--level", "LEVEL", "only this level, L0 to L4; may be repeated"),
            several(
                "--only", "NAME", "only this equation, subject, group or case; may be repeated"
            ),
            switch("--strict", "require all digits, even where the printed formula loses some"),
        ),
    ),
}
# {heading of a group, for whom it is: {name: (function, help, arguments)}}
GROUPS = {
    "The main job, for everyone who follows the paper": {
        "demo": (
            "job.demo",
            "run the whole pipeline: train on a scene, compress, decode, render and measure",
            (
                option("scene", nargs="?", default="bouncing", help=SCENE_HELP),
                DOWNSCALE,
                *SETTINGS,
                output("folder for the report (default report)", default="report"),
            ),
        ),
        "train": (
            "job.train",
            "train on a scene and write a run folder",
            (
                SCENE,
                DOWNSCALE,
                *SETTINGS,
                option(
                    "--points",
                    metavar="FILE",
                    help="start from the points in a .npy or .ply file, in scene coordinates",
                ),
                output("run folder to write", required=True),
                switch("--resume", "continue from the checkpoint in the run folder"),
            ),
        ),
        "encode": (
            "job.encode",
            "compress a run to a file",
            (option("run", help="run folder of `train`"), output("file to write", required=True)),
        ),
        "decode": (
            "job.decode",
            "write the arrays of a file to model.npz and its design to model.json",
            (FILE, NEW_FOLDER),
        ),
        "render": (
            "job.render",
            "render a file over time, from a fixed camera or from a scene's test cameras",
            (
                FILE,
                output("new folder to write to", required=True),
                option(
                    "--azimuth",
                    type=number_in_range(float, -360, 360),
                    help="direction of the camera in degrees about the z axis (default 40)",
                ),
                option(
                    "--elevation",
                    type=number_in_range(float, -89, 89),
                    help="angle of the camera in degrees above the xy plane (default 30)",
                ),
                option(
                    "--distance",
                    type=number_in_range(float, 1e-3, 1e6),
                    help="to the anchors (default 3.6), with a field of view of 41 degrees",
                ),
                option(
                    "--size",
                    type=number_in_range(int, 1, 4096),
                    help="pixels along a side (default 128)",
                ),
                option(
                    "--frames",
                    type=number_in_range(int, 1, 10_000),
                    help="number of pictures from time 0 to time 1 (default 24)",
                ),
                option("--scene", help="use the test cameras and times of this scene instead"),
                DOWNSCALE,
            ),
        ),
        "evaluate": (
            "job.evaluate",
            "measure a file on the test views of a scene",
            (FILE, SCENE, DOWNSCALE, JSON, output("folder for comparison.png and comparison.csv")),
        ),
    },
    "Files, for those who simulate a scene or look inside a file": {
        "simulate": (
            "job.simulate",
            "draw the pictures of a scene.json",
            (option("scene", help="a scene.json"), NEW_FOLDER),
        ),
        "inspect": (
            "job.inspect",
            "list the bytes and the entropy of each section of a file",
            (FILE, JSON),
        ),
        "view": (
            "job.view",
            "write a self-contained page that shows files in a browser",
            (
                option("files", nargs="+", metavar="FILE", help="a .p4dgs file"),
                output("page to write (default beside the first FILE)"),
            ),
        ),
        "presets": (
            "job.presets",
            "print the presets beside the paper's values",
            (option("preset", nargs="?", help="print all fields of this preset"),),
        ),
    },
    "Ports, for authors of an implementation in another language": {
        "oracle": (
            "",
            "export golden vectors; check a port and name the first wrong equation",
            ORACLE,
        ),
    },
    "Measure, for those who ask what a choice costs": {
        "accuracy": (
            "lab.accuracy",
            "measure what accuracy costs in time: renderers, precision, Eq. (11), noise",
            (
                option(
                    "file",
                    nargs="?",
                    help="a .p4dgs file (default: a small model that is installed)",
                ),
                option("scene", nargs="?", default="bouncing", help="its scene (if not bouncing)"),
                DOWNSCALE,
                output(
                    "folder for accuracy.png and accuracy.csv (default report)", default="report"
                ),
            ),
        ),
        "stability": (
            "lab.hard_cases",
            "list hard cases (printed formula, ours, true value) and draw a map of errors",
            (
                JSON,
                option("--only", metavar="ID", help="run only this case or group, such as H-R1"),
                switch("--all", "print every row, not only the worst of each equation"),
                output(
                    "folder for stability.png (the map) and stability.csv (default report)",
                    default="report",
                ),
            ),
        ),
        "effects": (
            "lab.effects",
            "count what each effect of a scene costs, and show that others cost nothing",
            (
                SCENE,
                DOWNSCALE,
                JSON,
                switch(
                    "--suggest",
                    "train briefly and print which effects the pictures call for, and why",
                ),
                switch("--apply", "with --suggest: write the list to the scene's scene.json"),
                YES,
                output("folder for effects.png and effects.csv (default report)", default="report"),
            ),
        ),
    },
    "Teach, for teachers and their students": {
        "classroom": (
            "lab.classroom",
            "write the equations: without bodies for students, complete for the teacher",
            (
                option(
                    "folder",
                    help="folder to write to; an existing classroom keeps the files of students",
                ),
                several("--only", "KEY", "only this equation; may be repeated"),
            ),
        ),
        "grade": (
            "lab.grade",
            "grade the equations of students on inputs that they have not seen",
            (
                option(
                    "folders",
                    nargs="+",
                    metavar="DIR",
                    help="the folder student/ of a student, or a folder that contains it",
                ),
                JSON,
                option(
                    "--classroom",
                    metavar="DIR",
                    help="classroom whose equations are graded (default: the first DIR)",
                ),
                option(
                    "--seed",
                    type=number_in_range(int, 0),
                    metavar="N",
                    help="seed of the inputs, to be kept from students (default: a random one)",
                ),
                output("folder for grades.txt and grades.csv"),
            ),
        ),
    },
}


def in_groups():
    """Return the commands under the headings of their groups, for the top-level help."""
    lines = ["P-4DGS in NumPy: train on tiny moving scenes; compress, decode and render them."]
    for heading, commands in GROUPS.items():
        lines += ["", f"{heading}:"]
        lines += [f"  {name:<11} {help}" for name, (_, help, _) in commands.items()]
    return "\n".join(lines)


def add_commands(parent, kind, table, **shown):
    """Give a parser the commands of a table; a command may have commands of its own."""
    named = {"dest": kind, "metavar": kind.upper(), "prog": parent.prog}
    commands = parent.add_subparsers(required=True, **named, **shown)
    for name, (function, help, arguments) in table.items():
        entry = commands.add_parser(
            name,
            help=help,
            description=help,
            # a column for the longest option
            formatter_class=lambda prog: argparse.HelpFormatter(prog, max_help_position=28),
        )
        entry.set_defaults(function=function)
        if isinstance(arguments, dict):
            add_commands(entry, "action", arguments)
        else:
            for names, settings in arguments:
                entry.add_argument(*names, **settings)


def parser():
    """Return the parser of all commands."""
    top = Parser(
        prog="p4dgs-ref",
        usage="%(prog)s [-h] [--version] COMMAND ...",
        description=in_groups(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument(
        "--version", action=Version, nargs=0, help="print versions, kernels and what is promised"
    )
    every = {name: row for commands in GROUPS.values() for name, row in commands.items()}
    add_commands(top, "command", every, help=argparse.SUPPRESS)
    return top


# The end of the message of a stopped command: what is kept, and how to continue.
STOPPED = {
    "train": "; if the run folder has a checkpoint, the same command with --resume continues",
    "demo": "; nothing is kept before the training ends; `p4dgs-ref train` keeps checkpoints, from "
    "which --resume continues",
}


def run(argv, start):
    """Parse and run a command; returns the exit code.

    Exit codes: 0 success, 1 failed training or check, 2 invalid input, 130 interrupted. Every
    ValueError that this package defines means invalid input; any other is a bug.
    """
    arguments = parser().parse_args(argv, argparse.Namespace(start=start))
    module, name = arguments.function.split(".")
    with warnings.catch_warnings():
        # Kernels for ARM (OpenBLAS with SME, Accelerate) raise flags although all numbers are good.
        warnings.filterwarnings("ignore", ".* encountered in matmul", RuntimeWarning)
        # These are messages of the command; `python -W error` must not turn them into tracebacks.
        warnings.filterwarnings("default", category=UserWarning)
        # In one line and at once; the place in the code would mean nothing to a user.
        warnings.showwarning = lambda message, *place, **stream: print_warning(message)
        try:
            with deferred():  # not in the middle of an import
                function = getattr(import_module(f".{module}", __package__), name)
            return function(arguments) or 0
        except KeyboardInterrupt as stop:
            code, message = 130, f"stopped{str(stop) or STOPPED.get(arguments.command, '')}"
        except (ArithmeticError, MemoryError, ChildProcessError) as error:
            code, message = 1, str(error) or "out of memory"
        except ModuleNotFoundError as error:  # a copy without some rooms; another module is a bug
            if not str(error.name).startswith("p4dgs_ref."):
                raise
            code, message = 2, f"{arguments.command}: {error.name} is not in this installation"
        except OSError as error:
            code, message = 2, f"{error.filename or 'output'}: {error.strerror or error}"
        except ValueError as error:
            if not type(error).__module__.startswith("p4dgs_ref."):
                raise
            code, message = 2, error
    print_message(message)
    return code
