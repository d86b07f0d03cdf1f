"""The form of the tutorials, checked on their source: cells, headings, length of prose, numbers that no cell asserts.

A file in percent format is a run of cells; each begins with a line `# %%`, prose with `# %% [markdown]`.

Numbers in prose.  Every number written in digits must stand, with the same value, in an assert of the first code cell that
follows: as a number of its own, or in a text that the assert compares.  Not counted are digits in mathematics between
dollars, in `code`, in the number of an equation, Eqs. (3) and (4), of an exercise, **01.2**, of a tutorial, section, figure
or stage, of a list's item, in the year of a citation, and digits of a name with letters (3DGS, float32, Q24, L1).
"""

import ast
import io
import re
import tokenize
from typing import NamedTuple

HEADINGS = [
    "Claim",
    "By hand",
    "In code",
    "Backward by hand",
    "Break it",
    "What a codec does with it",
    "Exercises",
    "Check your port",
]
MOST_LINES, WIDEST = 4, 130
NUMBER = re.compile(r"(?<![\w.])(\d[\d,_]*\d|\d)(\.\d+)?(e[+-]?\d+)?(?!\w)")
# What is cut out of prose before numbers are looked for, in this order.
NOT_COUNTED = (
    r"\$\$.*?\$\$",
    r"\$[^$]*\$",
    r"``.*?``",
    r"`[^`]*`",
    r"\]\([^)]*\)",
    r"\*\*\d\d\.\d\*\*",
    r"\b[Ee]xercises? \d\d\.\d",
    r"\bEqs?\.\s*\(\d+'?\)(?:(?:,| and| to|, and)\s*\(\d+'?\))*",
    r"\(\d+'\)",
    r"\b[Tt]utorials? \d\d(?:(?:,| and| to|-) ?\d\d)*",
    r"\b[Ss]ections? \d(?:\.\d)*",
    r"\bFigs?\. \d",
    r"\b[Ss]tages? \d(?:(?:,| and| to| or) \d)*",
    r"^\*\*\d(?:, \d)*:",
    r"^\s*\d+\.\s",
    r"\bet al\.,? \(?\d{4}\)?",
)


class Cell(NamedTuple):
    """One cell: its first line's number in the file, whether it is prose, its lines without the marker."""

    line: int
    prose: bool
    lines: list

    @property
    def text(self):
        """Prose without comment signs, or code."""
        return (
            "\n".join(re.sub(r"^# ?", "", line) for line in self.lines)
            if self.prose
            else "\n".join(self.lines)
        )


def cells(source):
    """The cells of a file."""
    found = []
    for i, line in enumerate(source.splitlines(), 1):
        if line.startswith("# %%"):
            found.append(Cell(i, line.strip() == "# %% [markdown]", []))
        elif found:
            found[-1].lines.append(line)
    return found


def headings(source):
    """The second-level headings in order."""
    return [
        line[3:]
        for cell in cells(source)
        if cell.prose
        for line in cell.text.splitlines()
        if line.startswith("## ")
    ]


def long_cells(source):
    """Cells with more than four lines of prose, lines that are too wide, code among prose: ["line 5: ...", ...]."""
    found = []
    for cell in cells(source):
        if not cell.prose:
            continue
        said = [
            line for line in cell.text.splitlines() if line.strip() and not line.startswith("#")
        ]
        if len(said) > MOST_LINES:
            found.append(f"line {cell.line}: {len(said)} lines of prose, at most {MOST_LINES}")
        for i, line in enumerate(cell.lines, cell.line + 1):
            if len(line) > WIDEST:
                found.append(f"line {i}: {len(line)} characters, at most {WIDEST}")
            if line.strip() and not line.startswith("#"):
                found.append(f"line {i}: code in a cell of prose")
    return found


def numbers(text):
    """The numbers of prose that something must assert, as they are written."""
    for pattern in NOT_COUNTED:
        text = re.sub(pattern, " ", text, flags=re.DOTALL | re.MULTILINE)
    return [match[0] for match in NUMBER.finditer(text)]


def asserted(code):
    """The values of all numbers that stand in asserts of a cell."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Assert):
            source = ast.get_source_segment(code, node)
            for token in tokenize.generate_tokens(io.StringIO(source).readline):
                if token.type == tokenize.NUMBER:
                    found.add(_value(token.string))
                elif (
                    token.type == tokenize.STRING
                    or tokenize.tok_name[token.type] == "FSTRING_MIDDLE"
                ):
                    found.update(_value(match[0]) for match in NUMBER.finditer(token.string))
    return found


def _value(text):
    text = text.replace(",", "").replace("_", "")
    try:
        return float(text)
    except ValueError:  # 0xff, 3j
        return ast.literal_eval(text)


def unasserted(source):
    """Numbers of prose that the next code cell does not assert: ["line 5: 0.63", ...]."""
    found, all_cells = [], cells(source)
    for i, cell in enumerate(all_cells):
        if cell.prose:
            code = next((c.text for c in all_cells[i + 1 :] if not c.prose), "")
            held = asserted(code)
            found += [f"line {cell.line}: {n}" for n in numbers(cell.text) if _value(n) not in held]
    return found
