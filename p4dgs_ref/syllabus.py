"""The tutorials in order, and tutorials/README.md made of them.

python -m p4dgs_ref.syllabus              run and measure every tutorial, draw the gallery anew, write the index
python -m p4dgs_ref.syllabus 06 20 demo   only these tutorials, and the main job that draws the demo's pictures
python -m p4dgs_ref.syllabus accuracy     the studies of accuracy against time whose pictures are shown
python -m p4dgs_ref.syllabus index        the index alone
"""

import ast
import os
import re
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import NamedTuple

from .table import rows

FOLDER = Path(__file__).resolve().parents[1] / "tutorials"


class Tutorial(NamedTuple):
    """One file of tutorials/."""

    name: str
    keys: tuple = ()  # of the equations that it explains

    @property
    def number(self):
        return self.name[:2]


TUTORIALS = tuple(
    Tutorial(name, tuple(keys.split()))
    for name, keys in (
        ("01_offsets", "offsets"),
        ("02_view", "view"),
        ("03_opacity_and_masking", "opacity masking mlp"),
        ("04_color_rotation_scale", "color rotation scale"),
        ("05_positional_encoding_and_deformation", "positional_encoding deformation"),
        ("06_deformed", "deformed"),
        ("07_noise_and_rounding", "noise rounding"),
        ("08_step", "step"),
        ("09_hash_grid", "hash_grid"),
        ("10_prior_and_likelihood", "likelihood prior"),
        ("11_rate", "anchor_rate hash_rate rate_loss"),
        ("12_losses", "total_loss render_loss ssim"),
        ("13_covariance", "covariance"),
        ("14_projection", "projection"),
        ("15_compositing", "compositing"),
        ("16_pipeline_by_hand", ""),
        ("17_four_stages", ""),
        ("18_one_training_step", ""),
        ("19_file_byte_by_byte", ""),
        ("20_intervals_to_rans", ""),
        ("21_desync", ""),
        ("22_five_questions_about_bits", ""),
        ("23_accuracy_versus_time", ""),
        ("24_hard_cases", ""),
        ("25_effects", ""),
        ("26_video_codec_analogy", ""),
        ("27_rate_distortion", ""),
    )
)


def tutorial_of(key):
    """The tutorial that explains an equation."""
    return next(tutorial for tutorial in TUTORIALS if key in tutorial.keys)


# --- what a tutorial says of itself --------------------------------------------------------------------------------
class Facts(NamedTuple):
    """What stands in a tutorial's file."""

    title: str
    after: tuple  # numbers of the tutorials before it
    reading: str  # "half an hour"
    exercises: dict  # "01.2" -> keys of the equations that it is about; none where it is about all of the tutorial


def facts(tutorial, folder=FOLDER):
    """Facts of a tutorial, read from its file.

    Raises     ValueError naming the file and what was expected
    """
    path = Path(folder) / f"{tutorial.name}.py"
    source = path.read_text(encoding="utf-8")
    title = re.match(r"# %% \[markdown\]\n# # (.*)\n", source)
    head = " ".join(
        line.lstrip("# ").strip() for line in source.split("\n# %%", 1)[0].splitlines()[2:]
    )
    parts = re.search(r"\*\*Before it:\*\*(.*?)\*\*Takes\*\*.*?two cores,\s+(.*?) of yours", head)
    if not title or not parts:
        raise ValueError(
            f"{path.name}: expected a title, then **Before it:** ... **Takes** ... on two cores, ... of yours"
        )
    return Facts(title[1], _before(parts[1]), parts[2], exercises(source, tutorial.keys))


def _before(text):
    """Numbers of the tutorials that a text names; "`01_offsets` to `15_compositing`" names all between."""
    named = []
    for first, last in re.findall(r"`(\d\d)\w*`(?: to `(\d\d)\w*`)?", text):
        named += [t.number for t in TUTORIALS if first <= t.number <= (last or first)]
    return tuple(dict.fromkeys(named))


def exercises(source, keys):
    """{exercise: keys of the equations that its check is about} of a tutorial's or its solutions' source."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        if not (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and isinstance(node.func.value, ast.Name)
            and node.func.value.id == "lessons"
            and node.func.attr in ("number", "forward", "backward")
        ):
            continue
        number = node.args[0].value
        if node.func.attr == "number":
            about = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
        else:
            about = {_equation(node.args[2].value)}
        found[number] = tuple(key for key in keys if key in about) or keys
    return dict(sorted(found.items()))


def _equation(subject):
    """The equation that a subject of the vectors is about."""
    return _equations()[subject]


@cache
def _equations():
    from .oracle.vectors import read_manifest

    return {s["key"]: s["equation"] for s in read_manifest()["subjects"]}


# --- tables --------------------------------------------------------------------------------------------------------
def equations_table(folder=FOLDER):
    """The table of equations as Markdown: number, key, file, vectors, tutorial, exercises; one row each."""
    about = {}
    for tutorial in TUTORIALS:
        for exercise, keys in facts(tutorial, folder).exercises.items():
            for key in keys:
                about.setdefault(key, []).append(exercise)
    lines = ["| no. | key | file | vectors | tutorial | exercises |", "|---|---|---|---|---|---|"]
    for row in rows():
        key, name = row["key"], tutorial_of(row["key"]).name
        lines.append(
            f"| {row['number']} | `{key}` | [`{row['file']}`](../{row['file']}) | "
            f"[`{key}.safetensors`](../p4dgs_ref/oracle/v1/{key}.safetensors) | [{name}]({name}.py) | "
            f"{', '.join(about.get(key, []))} |"
        )
    return "\n".join(lines)


def order_table(seconds, folder=FOLDER):
    """The tutorials in order as Markdown; seconds: {number: measured}."""
    lines = [
        "| tutorial | what it is about | after | exercises | seconds | reading |",
        "|---|---|---|---|---|---|",
    ]
    for tutorial in TUTORIALS:
        own = facts(tutorial, folder)
        measured = f"{seconds[tutorial.number]:.1f}" if tutorial.number in seconds else ""
        lines.append(
            f"| [{tutorial.name}]({tutorial.name}.py) | {own.title} | {_listed(own.after)} | "
            f"{len(own.exercises)} | {measured} | {own.reading} |"
        )
    return "\n".join(lines)


def _listed(numbers):
    """ "07, 10", or "01 to 15" where all between are meant."""
    between = [t.number for t in TUTORIALS if numbers and numbers[0] <= t.number <= numbers[-1]]
    return (
        f"{numbers[0]} to {numbers[-1]}"
        if len(numbers) > 2 and list(numbers) == between
        else ", ".join(numbers)
    )


def graph(folder=FOLDER):
    """Prerequisites as a Mermaid graph; an arrow that follows from two others is left out."""
    before = {tutorial.number: set(facts(tutorial, folder).after) for tutorial in TUTORIALS}
    reach = {}
    for number in before:  # prerequisites come before what needs them
        reach[number] = set().union(*(reach[n] | {n} for n in before[number]))
    lines = ["```mermaid", "graph LR"]
    for tutorial in TUTORIALS:
        number = tutorial.number
        lines.append(f'    t{number}["{number} {tutorial.name[3:].replace("_", " ")}"]')
        lines += [
            f"    t{n} --> t{number}"
            for n in sorted(before[number])
            if not any(n in reach[other] for other in before[number])
        ]
    return "\n".join([*lines, "```"])


def measured_before(folder=FOLDER):
    """{number: seconds} that README.md holds; empty without one."""
    path = Path(folder) / "README.md"
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    found = re.findall(r"^\| \[(\d\d)_.*\| (\d+\.\d) \| [^|]* \|$", text, re.M)
    return {number: float(seconds) for number, seconds in found}


def index(seconds, folder=FOLDER):
    """tutorials/README.md with its tables made anew; what stands outside the marks <!-- order --> ... <!-- end --> stays."""
    from .gallery import gallery

    text = (Path(folder) / "README.md").read_text(encoding="utf-8")
    for name, made in {
        "order": order_table(seconds, folder),
        "graph": graph(folder),
        "equations": equations_table(folder),
        "gallery": gallery(),
    }.items():
        before, after = text.split(f"<!-- {name} -->\n", 1)
        text = f"{before}<!-- {name} -->\n{made}\n<!-- end -->" + after.split("<!-- end -->", 1)[1]
    return text


# --- measuring -----------------------------------------------------------------------------------------------------
def run(tutorial, out, folder=FOLDER):
    """Run a tutorial headless with its figures in `out`; (seconds, finished process)."""
    environment = {
        **os.environ,
        "MPLBACKEND": "Agg",
        "P4DGS_TUTORIALS_OUT": str(out),
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(
            [str(FOLDER.parent), os.environ.get("PYTHONPATH", "")]
        ).rstrip(os.pathsep),
    }
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, str(Path(folder) / f"{tutorial.name}.py")],
        env=environment,
        capture_output=True,
        text=True,
        cwd=out,
    )
    return time.perf_counter() - start, done


def main(chosen):
    """Measure what is chosen (all if nothing), renew its part of the gallery, write the index."""
    from .gallery import main_job, studies, take
    from .scenes.output import write_atomically

    unknown = set(chosen) - {
        "demo",
        "accuracy",
        "index",
        *(tutorial.number for tutorial in TUTORIALS),
    }
    if unknown:
        sys.exit(
            f"{' '.join(sorted(unknown))}: expected numbers of tutorials, 'demo', 'accuracy' or 'index'"
        )
    seconds = measured_before()
    with tempfile.TemporaryDirectory() as out:
        for tutorial in TUTORIALS:
            if not chosen or tutorial.number in chosen:
                seconds[tutorial.number], done = run(tutorial, out)
                if done.returncode:
                    sys.exit(f"{tutorial.name}.py: {done.stderr.strip().splitlines()[-1]}")
                print(f"{tutorial.name}: {seconds[tutorial.number]:.1f} s", flush=True)
        if not chosen or "demo" in chosen:
            main_job(out)
        if not chosen or "accuracy" in chosen:
            studies(out)
        take(out, FOLDER / "pictures")
    text = index(seconds).encode()
    write_atomically(FOLDER / "README.md", lambda file: file.write(text))


if __name__ == "__main__":
    main(sys.argv[1:])
