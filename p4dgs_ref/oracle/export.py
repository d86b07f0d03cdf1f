"""Copies the published vectors into a folder, for ports that read files."""

import json
import shutil
from pathlib import Path

from ..codec import published as codec
from ..codec.container import BitstreamError
from ..scenes.output import OutputError, filled
from . import safetensors, streams
from .published import FOLDER, VERSIONS, read_manifest


def export(folder, version=VERSIONS[-1]):
    """Copy a version of the published vectors into a folder; return {output, files, bytes, cases}.

    The folder `codec` beside them holds what a right port answers to the streams, as an example.
    Raises OutputError where the folder holds other things, because files could be overwritten.
    """
    place = Path(folder)
    if place.is_dir() and any(place.iterdir()) and not (place / "manifest.json").is_file():
        raise OutputError(
            f"{folder}: expected an empty folder, or an earlier export with its manifest.json"
        )
    manifest = read_manifest(version=version)
    with filled(folder) as beside:
        for file in sorted(FOLDER.iterdir()):
            asked = file.suffix != ".safetensors" or file.name in manifest["files"]
            if file.is_file() and asked:
                shutil.copyfile(file, beside / file.name)
        if version != VERSIONS[-1]:
            (beside / "manifest.json").write_text(
                json.dumps(manifest, separators=(",", ":")), encoding="utf-8"
            )
        copy_streams(beside)
        write_expected(beside)
        sizes = [file.stat().st_size for file in beside.rglob("*") if file.is_file()]
    cases = sum(len(subject["cases"]) for subject in manifest["subjects"])
    return {
        "output": str(folder),
        "files": len(sizes),
        "bytes": sum(sizes),
        "cases": cases + len(manifest["streams"]),
    }


def copy_streams(folder):
    """Copy the conformance streams to `folder`/streams, where the manifest says they are."""
    shutil.copytree(codec.FOLDER, Path(folder) / "streams", dirs_exist_ok=True)


def write_expected(folder):
    """Decode every stream and write what was found into `folder`/codec, as a port would."""
    place, refusals, rows = Path(folder) / "codec", {}, streams.read_rows()
    place.mkdir(parents=True, exist_ok=True)
    for row in rows["good"] + rows["bad"]:
        try:
            arrays = streams.decoded((codec.FOLDER / row["file"]).read_bytes())
        except BitstreamError as error:
            refusals[row["name"]] = str(error)
        else:
            (place / f"{row['name']}.safetensors").write_bytes(safetensors.dump(arrays)[0])
    (place / "refusals.json").write_text(json.dumps(refusals, indent=1), encoding="utf-8")
