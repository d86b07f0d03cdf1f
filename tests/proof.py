"""Sixty training steps of both designs and what follows, as SHA-256: `python -m tests.proof`.

On every x86-64 Linux machine with AVX2 and with the same versions of the packages it prints the
same, also where `qemu-x86_64 -cpu Haswell` stands before it.
"""

import hashlib
import json

import p4dgs_ref as p4

p4.prepare()


def proof(stage_ends=(10, 20, 40, 60)):
    """The SHA-256 of all parameters, of the file and of a picture drawn from it, of each design."""
    from p4dgs_ref.training.fit import fit

    scene, found = p4.load_scene("bouncing"), {}
    view = scene.test[0]
    for preset in ("tiny", "tiny_coded"):
        trainer = fit(scene, preset, 0, stage_ends=stage_ends)
        data = p4.encode(trainer.model())
        picture = p4.decode(data).render(view.camera, view.time)
        found[f"{preset}: parameters"] = trainer.parameters.vector.tobytes()
        found[f"{preset}: file"] = data
        found[f"{preset}: picture"] = picture.tobytes()
    return {what: hashlib.sha256(data).hexdigest() for what, data in found.items()}


if __name__ == "__main__":
    from p4dgs_ref.arithmetic import arithmetic

    print(json.dumps({"arithmetic": arithmetic(), **proof()}, indent=1))
