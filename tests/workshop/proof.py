"""Sixty steps of `tiny` and what follows, as SHA-256: `python -m tests.workshop.proof`.

On every x86-64 Linux machine with AVX2 and with the same versions of the packages it prints the
same, also where `qemu-x86_64 -cpu Haswell` stands before it. An emulated processor needs 12 to 19
times as long, so views and model are small.
"""

import hashlib
import json

import p4dgs_ref as p4
from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer

CHANGES = dict(stage_ends=(10, 20, 40, 60), grow_from=10, grow_every=15, mask_from=20, anchors=20)


def proof():
    """The arithmetic, and the SHA-256 of all parameters, the file and a picture."""
    scene, outputs = p4.load_scene("bouncing", downscale=4), {}
    view = scene.test[0]
    trainer = Trainer(scene, choose("tiny", CHANGES), seed=0)
    data = p4.encode(trainer.run())
    picture = p4.decode(data).render(view.camera, view.time)
    outputs["tiny: parameters"] = trainer.parameters.vector.tobytes()
    outputs["tiny: file"] = data
    outputs["tiny: picture"] = picture.tobytes()
    hashes = {what: hashlib.sha256(data).hexdigest() for what, data in outputs.items()}
    return {"arithmetic": arithmetic(), **hashes}


if __name__ == "__main__":
    print(json.dumps(proof(), indent=1))
