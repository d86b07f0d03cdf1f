"""Checking an answer loads what checks answers, and nothing else."""

import subprocess
import sys

CHECK = """
import sys
from p4dgs_ref import oracle

report = oracle.check(lambda x_a, O_a, l_a: x_a[:, None] + O_a * l_a[:, None], "offsets")
wrong = oracle.check(lambda x_a, O_a, l_a: x_a[:, None] + O_a, "offsets")
assert report.ok and "[offsets-not-scaled]" in str(wrong), wrong
print("\\n".join(name for name in sys.modules if name.partition(".")[0] == "p4dgs_ref"))
"""


def test_a_check_of_one_equation_loads_few_modules():
    done = subprocess.run(
        [sys.executable, "-c", CHECK], capture_output=True, text=True, check=True, timeout=60
    )
    loaded = done.stdout.split()
    assert len(loaded) <= 20, loaded
    rooms = {name.split(".")[1] for name in loaded if "." in name}
    assert rooms <= {"oracle"}, rooms
