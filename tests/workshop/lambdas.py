"""`python -m tests.workshop.lambdas` makes the demo's page, with files of other lambda_rate.

It trains five times. Only the page holds the four other files; a slow test makes one of them again.
"""

from pathlib import Path

import p4dgs_ref as p4
from p4dgs_ref.report import view
from tutorials.tools.figures import THREAD

from .demo import file

PAGE = Path(__file__).parents[2] / "tutorials" / "viewer" / "demo.html"
OTHERS = (5e-5, 2e-3, 8e-3, 3.2e-2)
RATES = (p4.PRESETS["tiny"].lambda_rate, *OTHERS)


def name_of(lambda_rate):
    """The name of a file in the page."""
    return f"lambda_rate={lambda_rate:g}.p4dgs" if lambda_rate in OTHERS else "demo.p4dgs"


def note(data, lambda_rate):
    """What the page says of a file beside its bytes."""
    metrics, *_ = p4.evaluate(p4.decode(data), p4.load_scene("bouncing"))
    return {"lambda_rate": lambda_rate, "psnr_db": round(metrics["psnr_db"], 2)}


def page(files, notes):
    """The page as bytes, which takes the viewer's scripts from where they are in a checkout."""
    text = view.with_files(files, notes)
    return text.replace('<script src="', '<script src="../../p4dgs_ref/viewer/').encode()


def main():
    """Train and write the page."""
    files = {name_of(rate): file(lambda_rate=rate) for rate in RATES}
    notes = {name_of(rate): note(files[name_of(rate)], rate) for rate in RATES}
    notes["demo.p4dgs"]["anchor"] = THREAD.index
    PAGE.write_bytes(page(files, notes))


if __name__ == "__main__":
    main()
