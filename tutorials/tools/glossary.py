"""The glossary of symbols: tutorials/glossary.md, written by `python -m tutorials.tools.syllabus`.

Every argument and output of an equation has a row. Shapes come from the comments in the signatures
and from the docstrings of `forward`; letters, meanings and units from names and comments, unless
the list below states them. The section is the frame of the drawing in which the equation stands.
"""

import re
from collections import namedtuple

from p4dgs_ref import EQUATIONS
from tests.workshop import shape_comments
from tutorials.tools.architecture import FRAMES
from tutorials.tools.shared import file_of, markdown_table

UNITS = (
    "scene units",
    "square scene units",
    "multiples of l_a",
    "units of the attribute",
    "pixels",
    "square pixels",
    "1 / square pixels",
)

STATED = re.compile(rf"\(({'|'.join(UNITS)})[;)]")  # the unit that a comment states

# A name in the code, of an argument, an output or a network; its letter in LaTeX, meaning and unit.
# What is not given is read from the name and from the first comment that states it.
Symbol = namedtuple("Symbol", "name letter meaning unit", defaults=(None, "", ""))

SYMBOLS = (
    Symbol("O_a", "O"),
    Symbol("delta_vc", unit="scene units"),
    Symbol("x", meaning="centres of the canonical Gaussians"),
    Symbol("color", "c", "colours: red, green, blue"),
    Symbol("r", meaning="rotations: unit quaternions (w, x, y, z)"),
    Symbol("tau_alpha", meaning="threshold of the opacity"),
    Symbol("index", meaning="which Gaussians are kept: child j of anchor a is number a k + j"),
    Symbol("E", r"\mathcal{E}", "positional encoding"),
    Symbol("p", "", "what is encoded: positions or times", "radians"),
    Symbol("delta_x", r"\Delta x", unit="scene units"),
    Symbol("delta_s", r"\Delta s", unit="scene units"),
    Symbol("delta_r", r"\Delta r"),
    Symbol("x_t", "x'", "centres at time t", "scene units"),
    Symbol("s_t", "s'", "standard deviations at time t; the sign has no effect", "scene units"),
    Symbol("r_t", "r'", "unit quaternions at time t"),
    Symbol("f", "f_a", "the numbers of one attribute: feature, scale, offset scaling, offsets"),
    Symbol("u", r"\mathcal{U}", "noise in [-1/2, 1/2)"),
    Symbol("f_noisy", r"\tilde f_a", "value with noise"),
    Symbol("f_hat", r"\hat f_a", "rounded value", "units of the attribute"),
    Symbol("symbols", meaning="the integers that are coded"),
    Symbol("grids", r"\mathcal{H}", "binary hash grid: parameters of which the sign is used"),
    Symbol("mu", unit="units of the attribute"),
    Symbol("sigma", unit="units of the attribute"),
    Symbol("bits", r"-\log_2 p", "bits of each value; in Eq. (17), of all values together", "bits"),
    Symbol("bits_f", r"-\log_2 p(\tilde f_a)", unit="bits"),
    Symbol("bits_s", r"-\log_2 p(\tilde s_a)", unit="bits"),
    Symbol("bits_l", r"-\log_2 p(\tilde l_a)", unit="bits"),
    Symbol("bits_O", r"-\log_2 p(\tilde{\mathbf{O}}_a)", unit="bits"),
    Symbol("R_anchor", r"R_{\rm anchor}", "bits of all anchors", "bits"),
    Symbol("R_hash", r"R_{\rm hash}", "bits of the hash grid", "bits"),
    Symbol("n_pos", "N_+", "number of entries of the grid that are +1"),
    Symbol("n_neg", "N_-", "number of entries of the grid that are -1"),
    Symbol("L1", r"\mathcal{L}_1", "mean absolute difference"),
    Symbol("ssim", meaning="structural similarity, 1 for equal images"),
    Symbol("D_SSIM", r"\mathcal{L}_{\rm D-SSIM}", "1 - SSIM"),
    Symbol("lambda_ssim", r"\lambda_{\rm SSIM}", "weight of 1 - SSIM"),
    Symbol("L_render", r"\mathcal{L}_{\rm render}", "rendering loss"),
    Symbol("n_parameters", "", "number of coded values, masked offsets included"),
    Symbol("L_rate", r"\mathcal{L}_{\rm rate}", "bits per coded value", "bits"),
    Symbol("lambda_rate", r"\lambda_{\rm rate}", unit="1 / bits"),
    Symbol("L_total", r"\mathcal{L}_{\rm total}", "what training minimises"),
    Symbol("Sigma", r"\Sigma", "covariances"),
    Symbol("focal", "f_x, f_y", "focal lengths"),
    Symbol("center", "c_x, c_y"),
    Symbol("mean2d", meaning="centres of the splats"),
    Symbol("cov2d", r"\Sigma_{2D}", "covariances of the splats, as (a, b, c)", "square pixels"),
    Symbol("conic", "K", "inverses of cov2d, as (a, b, c) of [[a, b], [b, c]]"),
    Symbol("depth", "z", "distance along the optical axis", "scene units"),
    Symbol("width", meaning="of the image", unit="pixels"),
    Symbol("transmittance", "T_N", "share of the background that a pixel shows"),
)
GREEK = ("alpha", "delta", "psi", "tau", "mu", "sigma", "lambda")
AXES = {
    "A": "anchors",
    "k": "children: Gaussians of one anchor",
    "d": "numbers of a feature",
    "N": "Gaussians that are kept; samples of a network or of an encoding",
    "D": "coordinates that are encoded",
    "I": "inputs of a network; for the hash feature, levels times F",
    "n": "numbers of an attribute, or of all attributes of an anchor",
    "G": "attribute groups, in the order f, s, l, O",
    "T": "entries of a level's table",
    "F": "features of an entry",
    "H": "rows of an image",
    "W": "columns of an image",
    "C": "colours of an image",
}
HEADS = ("letter", "name", "meaning", "shape", "unit", "equations")
# The network's own names, which stand for other symbols.
LEFT_OUT = {("mlp", "x"), ("mlp", "y"), "weights", "biases"}

INTRODUCTION = """\
# Glossary of symbols

The letters are those of the paper; in the section "Splatting" they are those of 3D Gaussian
splatting. A quantity without a letter has only a name, which is that of an argument or a result in
the code. A shape lists the axes of an array by the letters of the last table; a scalar has no
shape. A quantity without a unit is a plain number. The equation that computes a symbol is in bold;
the others use it. `python -m tutorials.tools.syllabus index` writes this page, mostly from the
comments in the code.
"""


# A symbol in one equation: whether it is computed there, its shapes as text, and its comment.
Mention = namedtuple("Mention", "key computed shapes comment")


def mentions():
    """{name: its Mentions in the order of the table}; networks have the names of their comments."""
    named = {}
    for key, equation in EQUATIONS.items():
        computed = shape_comments.outputs(equation.forward, equation.outputs)
        for name, spec in computed.items():
            if (key, name) not in LEFT_OUT:
                named.setdefault(name, []).append(Mention(key, True, written(spec), ""))
        for name, comment in shape_comments.comments(equation.forward).items():
            spec = shape_comments.parsed(comment)
            if spec.network:
                name = comment.split(",")[0]
            if not {name, (key, name)} & LEFT_OUT:
                named.setdefault(name, []).append(Mention(key, False, written(spec), comment))
    return {name: rows for name, rows in named.items() if name != "psi"}


def written(spec):
    """The shapes of a Spec as text, without those of effects that are off."""
    if spec.network:
        rows, *columns = spec.network
        return (f"{rows} → {' + '.join(column.strip() for column in columns)}",)
    prefix = "list of " if spec.is_list else ""
    shapes = (shape for shape in spec.shapes if shape and "0" not in shape)
    return tuple(f"{prefix}[{', '.join(shape)}]" for shape in shapes)


def meaning(key, comment):
    """What a comment says, without shape, unit, choices and additions after a semicolon."""
    if shape_comments.parsed(comment).network:
        return f"network of {key}"
    text = re.sub(r"^(list of )?\[[^]]*\](, one per level:)?", "", comment)
    text = re.sub(rf" ?\(({'|'.join(UNITS)}|Q\d+)(;[^)]*)?\)", "", text).split(";")[0]
    return re.sub(r", converted to .*|, > 0", "", text).strip()


def letter_of(name):
    """The letter in LaTeX of a name such as x_a, Q_0 or tau_alpha; "" for a word."""
    letter, _, below = name.partition("_")
    if letter not in GREEK and len(letter) > 1:
        return ""
    letter, below = (f"\\{part}" if part in GREEK else part for part in (letter, below))
    return f"{letter}_{{{below}}}" if below else letter


def row(name, places):
    """The cells of a symbol."""
    symbol = next((symbol for symbol in SYMBOLS if symbol.name == name), Symbol(name))
    letter = letter_of(name) if symbol.letter is None else symbol.letter
    places = sorted(places, key=lambda place: (not place.computed, not EQUATIONS[place.key].number))
    comments = " ".join(place.comment for place in places)
    meanings = (meaning(place.key, place.comment) for place in places)
    return (
        f"${letter}$" if letter else "",
        f"`{name}`",
        symbol.meaning or next(filter(None, meanings), ""),
        "; ".join(dict.fromkeys(shape for place in places for shape in place.shapes)),
        symbol.unit or next(iter(STATED.findall(comments)), ""),
        ", ".join(links(places)),
    )


def links(places):
    """Links to the equations, in bold to those that compute the symbol."""
    made = {}
    for place in places:
        equation = EQUATIONS[place.key]
        number = f"({equation.number})" if equation.number else place.key
        name = number.replace("')", f"') {place.key}")  # what Eq. (3) says by analogy
        link = f"[{name}](../{file_of(equation)})"
        made.setdefault(place.key, f"**{link}**" if place.computed else link)
    return made.values()


def section_of(places):
    """The title of the frame with the equation that computes a symbol, or first uses it."""
    first = min(places, key=lambda place: not place.computed)
    titles = {box.key: frame.title for frame in FRAMES for box in frame.boxes}
    return titles.get(first.key, "other equations")


def glossary():
    """The text of glossary.md."""
    sections = {frame.title: [] for frame in FRAMES}
    for name, places in mentions().items():
        sections.setdefault(section_of(places), []).append(row(name, places))
    tables = [
        f"## {title.capitalize()}\n\n{markdown_table(HEADS, rows)}\n"
        for title, rows in sections.items()
        if rows
    ]
    axes = f"## Axes\n\n{markdown_table(('letter', 'counts'), AXES.items())}\n"
    return "\n".join([INTRODUCTION, *tables, axes])
