"""Draws the packaged scenes anew: python -m tests.workshop.tiny_scenes [NAME ...] [-o DIR]."""

import argparse
import sys
from pathlib import Path

from p4dgs_ref.scenes.load import packaged_folder, packaged_scenes
from p4dgs_ref.scenes.simulator import simulate
from tests.workshop import two_cameras


def main(arguments=None):
    """Draw the named scenes, or all, beside their scene.json or into DIR/NAME."""
    names = packaged_scenes()
    parser = argparse.ArgumentParser(
        prog="python -m tests.workshop.tiny_scenes", description=main.__doc__
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(names)}")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder for the scenes")
    options = parser.parse_args(arguments)
    for name in options.names:
        if name not in names:
            parser.error(f"NAME: {name!r}; expected one of {', '.join(names)}")
    for name in options.names or names:
        scene = packaged_folder() / name
        folder = (options.output or packaged_folder()) / name
        if name == "twocams":
            two_cameras.draw(folder)
        else:
            simulate(scene / "scene.json", folder)
        print(f"{name}: drawn into {folder}")


if __name__ == "__main__":
    sys.exit(main())
