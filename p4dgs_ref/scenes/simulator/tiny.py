"""Draws the packaged scenes anew: python -m p4dgs_ref.scenes.simulator.tiny [NAME ...] [-o DIR]."""

import argparse
import sys
from pathlib import Path

from ..dnerf import packaged_folder, packaged_scenes
from ..scene import SceneError
from .simulate import simulate


def main(arguments=None):
    """Regenerate the named scenes (all without a name), next to their scene.json or under DIR/NAME."""
    parser = argparse.ArgumentParser(
        prog="python -m p4dgs_ref.scenes.simulator.tiny", description=main.__doc__
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"one of {', '.join(packaged_scenes())}"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="a folder for the scenes' folders"
    )
    options = parser.parse_args(arguments)
    for name in options.names:
        if name not in packaged_scenes():
            parser.error(f"NAME: {name!r}; expected one of {', '.join(packaged_scenes())}")
    for name in options.names or packaged_scenes():
        folder = packaged_folder() / name
        try:
            simulate(
                folder / "scene.json", folder if options.output is None else options.output / name
            )
        except SceneError as error:
            parser.error(str(error))
        print(f"{name}: drawn into {folder if options.output is None else options.output / name}")


if __name__ == "__main__":
    sys.exit(main())
