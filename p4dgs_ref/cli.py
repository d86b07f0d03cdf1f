"""The command line: what each command is called and takes; what it does stands in commands.py."""
import argparse
import os
import sys

from . import __version__, commands


class Parser(argparse.ArgumentParser):
    """argparse with its errors in one line."""

    def error(self, message):
        self.exit(2, f"p4dgs-ref: {message}; `{self.prog} --help` explains\n")


def parser():
    """All commands and their options."""
    top = Parser(prog="p4dgs-ref", description="P-4DGS in NumPy: fit, compress, decode and render tiny moving scenes.")
    top.add_argument("--version", action="version", version=f"p4dgs_ref {__version__}")
    sub = top.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)

    def command(name, help, function):
        entry = sub.add_parser(name, help=help, description=help)
        entry.set_defaults(function=function)
        return entry

    def out(entry, default=None, what="folder to write to"):
        entry.add_argument("-o", "--output", metavar="PATH", default=default, required=default is None, help=what)

    def training(entry, preset):
        entry.add_argument("--preset", default=preset, help=f"settings of the training (default {preset})")
        entry.add_argument("--seed", type=int, default=0, help="seed of everything random (default 0)")
        entry.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="changes",
                           help="change a field of the preset; may be repeated")
        entry.add_argument("--quiet", action="store_true", help="no progress line")
        entry.add_argument("--yes", action="store_true", help="go on although the estimate is over an hour")

    def scene(entry):
        entry.add_argument("scene", help="a folder in the D-NeRF layout, or the name of a packaged scene")
        view(entry)

    def view(entry):
        entry.add_argument("--background", default="white", help="white, black or r,g,b in 0..1 (default white)")
        entry.add_argument("--downscale", type=int, default=1, help="divide the image size by this (default 1)")

    def as_json(entry):
        entry.add_argument("--json", action="store_true", help="print JSON instead of text")

    e = command("demo", "fit a packaged scene, compress, decode, render, measure, draw: the main job", commands.demo)
    e.add_argument("scene", nargs="?", default="bouncing", help="scene (default bouncing)")
    view(e), out(e, "report", "folder of the report (default report)"), training(e, "tiny"), as_json(e)
    e = command("simulate", "draw the pictures of a scene.json", commands.simulate)
    e.add_argument("scene", help="a scene.json"), out(e), e.add_argument("--quiet", action="store_true"), as_json(e)
    e = command("train", "fit a scene", commands.train)
    scene(e), out(e, None, "run folder"), training(e, "tiny"), as_json(e)
    e.add_argument("--resume", action="store_true", help="go on from the checkpoint in the run folder")
    e = command("encode", "compress a run to a file", commands.encode)
    e.add_argument("run", help="run folder of `train`"), out(e, None, "file to write"), as_json(e)
    e = command("decode", "a file's arrays as npz, its settings as JSON", commands.decode)
    e.add_argument("file"), out(e), as_json(e)
    e = command("render", "pictures of a file", commands.render)
    e.add_argument("file"), out(e), as_json(e)
    e.add_argument("--scene", help="render this scene's cameras and times instead of a held camera"), view(e)
    e.add_argument("--split", default="test", choices=("train", "test", "val"), help="which of the scene's views")
    e.add_argument("--frames", type=int, default=24, help="times from 0 to 1 of the held camera (default 24)")
    e.add_argument("--azimuth", type=float, default=40.0, help="degrees about z (default 40)")
    e.add_argument("--elevation", type=float, default=30.0, help="degrees (default 30)")
    e.add_argument("--distance", type=float, default=3.6, help="from the box's centre, scene units (default 3.6)")
    e.add_argument("--fov", type=float, default=41.0, help="horizontal, degrees (default 41)")
    e.add_argument("--size", type=int, default=128, help="pixels along each side (default 128)")
    e.add_argument("--settings", default="fast", help="exact, paper or fast (default fast)")
    e = command("evaluate", "score a file on a scene's test views", commands.evaluate)
    e.add_argument("file"), scene(e), out(e, "", "folder for the comparison picture and table (optional)"), as_json(e)
    e = command("inspect", "a file's bytes, section by section", commands.inspect)
    e.add_argument("file"), out(e, "", "folder for the table and the picture (optional)"), as_json(e)
    as_json(command("equations", "the table of equations", commands.equations))
    e = command("presets", "what each preset changes, beside the paper's value", commands.presets)
    e.add_argument("preset", nargs="?", help="only this one, all fields"), as_json(e)
    e = command("bench", "time the renderer, the parts of a training step and the coder", commands.bench)
    as_json(e), e.add_argument("--quick", action="store_true", help="small sizes, a few seconds")
    return top


def user_errors():
    """The exceptions that are a user's mistake or a damaged file, imported late."""
    from .codec.container import BitstreamError
    from .codec.quantise import EncodeError
    from .scenes.scene import SceneError
    from .training.checkpoint import RunError
    return BitstreamError, EncodeError, SceneError, RunError, commands.UsageError


def run(argv, start):
    """Parse and run; returns the exit code: 0 well, 1 training failed, 2 a mistake of the user, 130 stopped."""
    arguments = parser().parse_args(argv)
    arguments.start = start
    try:
        arguments.function(arguments)
        sys.stdout.flush()
        return 0
    except KeyboardInterrupt:
        resume = f"; go on with: p4dgs-ref train {arguments.scene} -o {arguments.output} --resume" \
            if arguments.command == "train" else ""
        print(f"\np4dgs-ref: stopped{resume}", file=sys.stderr)
        return 130
    except BrokenPipeError:                        # `p4dgs-ref equations | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except user_errors() as error:
        print(f"p4dgs-ref: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"p4dgs-ref: {where}{error.strerror or error}", file=sys.stderr)
        return 2
    except ArithmeticError as error:
        print(f"p4dgs-ref: {error}", file=sys.stderr)
        return 1
