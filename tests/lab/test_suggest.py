"""What the pictures of a scene say about the effects in it."""

import io
import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref import output
from p4dgs_ref.cli import lab as commands
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.effects import MOTION
from p4dgs_ref.lab import suggest
from p4dgs_ref.scenes import MODEL_EFFECTS, SIMULATOR_EFFECTS, Scene, load_scene
from p4dgs_ref.scenes.load import packaged_folder
from p4dgs_ref.scenes.simulator import place_cameras, trace
from p4dgs_ref.scenes.simulator.description import read_description
from tests.sampling import of_the_day, turn
from tests.training.effect_scenes import described


def suggested(scene, **options):
    return {row["effect"]: row for row in suggest.suggest(scene, **options)}


@pytest.fixture
def quick(monkeypatch):
    """No training: every view gains what this dictionary says of its effect, give or take 0.1."""
    gains = dict.fromkeys(("translation", *suggest.OF_VIEW, "occlusion"), 0.0)
    noise = np.linspace(-0.1, 0.1, 8)
    monkeypatch.setattr(suggest, "gains_by_view", lambda task: gains[task[2]] + noise)
    return gains


@pytest.mark.parametrize(
    "gain, spread, apart, said",
    [
        (3.0, 0.1, 0, "yes"),
        (0.5, 0.1, 0, "yes"),
        (0.5, 1.0, 0, "cannot tell"),
        (0.2, 0.1, 0, "cannot tell"),
        (0.0, 0.1, 0, "no"),
        (-2.0, 0.1, 0, "no"),
        (0.0, 1.0, 0, "cannot tell"),
        (1.05, 0.0, 0.05, "yes"),
        (-0.75, 0.0, 0.75, "cannot tell"),
    ],
)
def test_verdict_asks_for_more_than_views_and_trainings_differ_by(gain, spread, apart, said):
    views = gain + spread * np.resize([-1, 1], 8)
    gains = [views - apart, views + apart]
    found, evidence = suggest.verdict("translation", gains, 48)
    assert found == said
    assert evidence.startswith(f"{gain:+.2f} ± ") and "dB on 16 views" in evidence


def test_every_effect_has_a_verdict_and_a_number(quick):
    scene = load_scene("bouncing")
    quick.update(translation=4.0, view_color=0.2, occlusion=9.0)
    rows = suggested(scene)
    assert tuple(rows) == MODEL_EFFECTS
    assert {effect: row["verdict"] for effect, row in rows.items()} == {
        "translation": "yes",
        "rotation": "cannot tell",
        "scaling": "cannot tell",
        "view_color": "cannot tell",
        "view_geometry": "no",
        "occlusion": "yes",
        "background": "yes",
    }
    for row in rows.values():
        assert any(c.isdigit() for c in row["evidence"]) and "\n" not in row["evidence"]
        assert row["called_for"] == (row["verdict"] != "no")
    quick.update(translation=0.0)
    assert not any(suggested(scene)[effect]["called_for"] for effect in MOTION)
    quick.update(translation=0.2)  # undecided: all three for the same reason
    rows = suggested(scene)
    assert {rows[effect]["verdict"] for effect in MOTION} == {"cannot tell"}
    assert all("+0.20 ± " in rows[effect]["evidence"] for effect in MOTION)


def test_one_time_and_few_views(quick):
    scene = load_scene("bouncing")
    assert suggest.seconds_of(scene, jobs=2) > 0
    assert suggest.seconds_of(replace(scene, train=scene.train[:11])) == 0
    frozen = suggested(replace(scene, train=[replace(view, time=0.5) for view in scene.train]))
    assert {frozen[effect]["verdict"] for effect in MOTION} == {"no"}
    assert "0.5" in frozen["translation"]["evidence"]
    few = suggested(replace(scene, train=scene.train[:11]))
    assert {row["verdict"] for name, row in few.items() if name != "background"} == {"cannot tell"}
    assert "11 views" in few["occlusion"]["evidence"]


def test_background_is_read_from_the_pixels(quick):
    scene = load_scene("bouncing")
    black = replace(scene, background=np.zeros(3))
    assert suggested(black)["background"]["verdict"] == "no"
    filled = [replace(v, alpha=None, image=np.full_like(v.image, 0.5)) for v in scene.train]
    assert suggested(replace(scene, train=filled))["background"]["verdict"] == "no"
    plain = [replace(v, alpha=None) for v in scene.train]
    assert suggested(replace(scene, train=plain))["background"]["verdict"] == "yes"


def test_dealt_out_values_are_those_of_other_views():
    views = load_scene("bouncing").train
    dealt = suggest.shuffle_views(views, "translation", 0)
    assert sorted(v.time for v in dealt) == sorted(v.time for v in views)
    assert sum(a.time != b.time for a, b in zip(dealt, views)) > 40
    assert all(a.image is b.image and a.camera is b.camera for a, b in zip(dealt, views))
    dealt = suggest.shuffle_views(views, "view_color", 0)
    moved = [a.camera.center - b.camera.center for a, b in zip(dealt, views)]
    assert np.count_nonzero(np.linalg.norm(moved, axis=1)) > 40
    assert all(np.array_equal(a.camera.T, b.camera.T) for a, b in zip(dealt, views))
    assert all(a.time == b.time and a.image is b.image for a, b in zip(dealt, views))


def test_both_halves_are_those_of_whole_trainings():
    """A training that goes on twice from its middle is the same as two trainings."""
    scene = load_scene("static", downscale=4)
    dealt = suggest.shuffle_views(scene.train, "translation", 1)
    options = set(MODEL_EFFECTS), 0, 12
    both = suggest.scores(scene, dealt, [scene.train, dealt], *options)
    alone = [suggest.scores(scene, dealt, [views], *options)[0] for views in (scene.train, dealt)]
    assert np.array_equal(both, alone) and not np.array_equal(*both)


def still(**changes):
    """A variation of the scene `static`, drawn anew."""
    description = read_description({**described("static", SIMULATOR_EFFECTS), **changes})
    posed = place_cameras(description, "train")
    return Scene.from_arrays(
        [np.rint(trace.trace(description, c, t) * 255).astype(np.uint8) for c, t in posed],
        [c for c, _ in posed],
        [t for _, t in posed],
    )


def bodies(**changes):
    return [{**body, **changes} for body in described("static", ())["bodies"]]


JUDGED = [
    ({}, "no"),
    ({"bodies": bodies(motion=[{"kind": "line", "by": [0.04, 0, 0]}])}, "yes"),
    ({"bodies": bodies(motion=[{"kind": "spin", "axis": [0, 0, 1], "degrees": 20}])}, "yes"),
]


@pytest.mark.slow
@turn("motion")
@pytest.mark.parametrize("changes, said", of_the_day(JUDGED))
def test_motion_is_judged_right_on_thin_slow_and_textured_things(changes, said):
    """Silhouettes called rods of one to three pixels moving, and missed a motion of one pixel."""
    scene = still(**changes)
    gains = [suggest.gains_by_view((scene, MOTION, "translation", fold, 600)) for fold in range(2)]
    found, evidence = suggest.verdict("translation", gains, len(scene.train))
    assert found == said, evidence


@pytest.fixture
def folder(tmp_path):
    """A copy of a packaged scene without a list of effects."""
    copy = tmp_path / "scene"
    shutil.copytree(packaged_folder() / "static", copy)
    (copy / "scene.json").unlink()
    return copy


@pytest.fixture
def run(monkeypatch):
    """The command line, in one process."""
    monkeypatch.setattr(commands, "JOBS", 1)
    monkeypatch.setattr(suggest, "seconds_of", lambda *_: 60)
    return lambda line: cli.run(line.split(), 0.0)


def test_apply_writes_the_list_beside_what_the_file_holds(folder, quick, run, capsys):
    quick.update(occlusion=9.0)
    assert run(f"effects {folder} --suggest --apply") == 2
    assert "minutes (short trainings): pass --yes to start" in capsys.readouterr().err
    assert run(f"effects {folder} --suggest --apply --yes") == 0
    assert "written to" in capsys.readouterr().out
    listed = ("occlusion", "background")
    assert json.loads((folder / "scene.json").read_text(encoding="utf-8")) == {
        "effects": list(listed)
    }
    assert load_scene(folder).effects == listed
    described_as = {"title": "mine", "effects": ["background", "texture"], "bodies": []}
    (folder / "scene.json").write_text(json.dumps(described_as), encoding="utf-8")
    assert run(f"effects {folder} --suggest --apply --yes") == 0
    kept = {**described_as, "effects": [*listed, "texture"]}
    assert json.loads((folder / "scene.json").read_text(encoding="utf-8")) == kept


@pytest.mark.parametrize("answer, code", [("y\n", 0), ("n\n", 130), ("", 130)])
def test_a_terminal_is_asked(answer, code, folder, run, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(suggest, "suggest", lambda *arguments: [])
    monkeypatch.setattr("sys.stdin", Terminal(answer))
    monkeypatch.setattr("sys.stderr", Terminal())
    assert run(f"effects {folder} --suggest") == code
    assert "continue? [y/N] " in sys.stderr.getvalue()


def test_a_list_that_cannot_be_written_is_refused_before_the_work(folder, run, monkeypatch, capsys):
    monkeypatch.setattr(suggest, "suggest", lambda *arguments: pytest.fail("the work began"))
    (folder / "scene.json").mkdir()
    assert run(f"effects {folder} --suggest --apply --yes") == 2
    assert "scene.json: a directory" in capsys.readouterr().err
    (folder / "scene.json").rmdir()

    def read_only(*arguments, **settings):
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr(output, "TemporaryDirectory", read_only)
    assert run(f"effects {folder} --suggest --apply --yes") == 2
    said = f"{folder}: expected a writable folder (Permission denied)"
    assert said in capsys.readouterr().err


def test_a_suggestion_that_is_stopped_promises_nothing(folder, run, monkeypatch, capsys):
    def stopped(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(suggest, "suggest", stopped)
    assert run(f"effects {folder} --suggest --yes") == 130
    assert capsys.readouterr().err.endswith("p4dgs-ref: stopped\n")
