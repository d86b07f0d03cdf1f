"""The glossary of symbols: tutorials/glossary.md, written by `python -m tutorials.tools.syllabus`.

Shapes come from the comments in the signatures of the equations and from the docstrings of their
`forward`; meanings and units come from these comments, unless the list below states them. The
letters come from the list, because a program cannot read them in the code.
"""

import re
from collections import namedtuple

from p4dgs_ref.splatting.table import EQUATIONS
from tests.golden import shape_comments
from tutorials.tools.shared import markdown_table

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

# One row: a letter of the paper in LaTeX, "" where neither the paper nor 3DGS has one, and its name
# in the code, of an argument, an output or a network. The meaning and the unit are those of the
# first comment that states them, unless they are given.
Symbol = namedtuple("Symbol", "letter name meaning unit", defaults=("", ""))

SECTIONS = {
    "Anchors": (
        Symbol("x_a", "x_a"),
        Symbol("f_a", "f_a"),
        Symbol("s_a", "s_a"),
        Symbol("l_a", "l_a"),
        Symbol("O", "O_a"),
        Symbol("", "mask", "False for a child that is masked for good and costs no bits"),
    ),
    "Spatial prediction": (
        Symbol("x_c", "x_c"),
        Symbol(r"\delta_{vc}", "delta_vc", unit="scene units"),
        Symbol("d_{vc}", "d_vc", "viewing direction, from the camera to the anchor"),
        Symbol(r"\psi_\alpha", "psi_alpha", "network of the opacities"),
        Symbol(r"\psi_c", "psi_c", "network of the colours"),
        Symbol(r"\psi_r", "psi_r", "network of the rotations"),
        Symbol(r"\psi_s", "psi_s", "network of the scales"),
        Symbol("x", "x", "centres of the canonical Gaussians", "scene units"),
        Symbol(r"\alpha", "alpha", "opacities"),
        Symbol("c", "color", "colours: red, green, blue"),
        Symbol("r", "r", "rotations: unit quaternions (w, x, y, z)"),
        Symbol("s", "s", "standard deviations along the axes of a Gaussian", "scene units"),
        Symbol(r"\tau_\alpha", "tau_alpha", "threshold of the opacity"),
        Symbol("", "index", "which Gaussians are kept: child i of anchor a is number a k + i"),
    ),
    "Temporal prediction": (
        Symbol("t", "t", "time, from 0 to 1"),
        Symbol(r"\mathcal{E}", "E", "positional encoding"),
        Symbol("", "p", "what is encoded: positions or times", "radians"),
        Symbol("L", "L", "number of frequencies of an encoding"),
        Symbol("", "L_x"),
        Symbol("", "L_t"),
        Symbol(r"\psi_d", "psi_d", "network of the deformation, with three heads"),
        Symbol(r"\Delta x", "delta_x", unit="scene units"),
        Symbol(r"\Delta s", "delta_s", unit="scene units"),
        Symbol(r"\Delta r", "delta_r"),
        Symbol("x'", "x_t", "centres at time t", "scene units"),
        Symbol("s'", "s_t", "standard deviations at time t; the sign has no effect", "scene units"),
        Symbol("r'", "r_t", "unit quaternions at time t"),
    ),
    "Quantisation": (
        Symbol("f_a", "f", "the numbers of one attribute: feature, scale, offset scaling, offsets"),
        Symbol(r"\mathcal{U}", "u", "noise in [-1/2, 1/2)"),
        Symbol("q", "q", "quantisation step, one for each anchor and attribute group"),
        Symbol("Q_0", "Q_0", "base step of each attribute group"),
        Symbol(r"\psi_q", "psi_q", "network of the steps"),
        Symbol(r"\tilde f_a", "f_noisy", "value with noise", "units of the attribute"),
        Symbol(r"\hat f_a", "f_hat", "rounded value", "units of the attribute"),
        Symbol("", "symbols", "the integers that are coded"),
    ),
    "Context and bits": (
        Symbol(r"\mathcal{H}", "grids", "binary hash grid: parameters of which the sign is used"),
        Symbol("", "resolutions", "axes and nodes per axis of every level"),
        Symbol("", "lo", unit="scene units"),
        Symbol("", "hi", "opposite corner of this box", "scene units"),
        Symbol("h", "h"),
        Symbol(r"\psi_p", "psi_p", "network of the prior: means and logarithms of sigma"),
        Symbol(r"\mu", "mu", unit="units of the attribute"),
        Symbol(r"\sigma", "sigma", unit="units of the attribute"),
        Symbol("", "widths", "coded values per anchor in each attribute group"),
        Symbol(r"-\log_2 p", "bits", "bits of each value; in Eq. (17) of the scene", "bits"),
        Symbol(r"-\log_2 p(\tilde f_a)", "bits_f", unit="bits"),
        Symbol(r"-\log_2 p(\tilde s_a)", "bits_s", unit="bits"),
        Symbol(r"-\log_2 p(\tilde l_a)", "bits_l", unit="bits"),
        Symbol(r"-\log_2 p(\tilde{\mathbf{O}}_a)", "bits_O", unit="bits"),
        Symbol(r"R_{\rm anchor}", "R_anchor", "bits of all anchors", "bits"),
        Symbol(r"R_{\rm hash}", "R_hash", "bits of the hash grid", "bits"),
        Symbol("N_+", "n_pos", "number of entries of the grid that are +1"),
        Symbol("N_-", "n_neg", "number of entries of the grid that are -1"),
    ),
    "Loss": (
        Symbol("", "image", "rendered image, intensities of range 1"),
        Symbol("", "truth"),
        Symbol("", "weight", "of each pixel in L1; 1 in the paper, ours is B3"),
        Symbol(r"\mathcal{L}_1", "L1", "mean absolute difference"),
        Symbol("", "ssim", "structural similarity, 1 for equal images"),
        Symbol(r"\mathcal{L}_{\rm D-SSIM}", "D_SSIM", "1 - SSIM"),
        Symbol(r"\lambda_{\rm SSIM}", "lambda_ssim", "weight of 1 - SSIM"),
        Symbol(r"\mathcal{L}_{\rm render}", "L_render", "rendering loss"),
        Symbol("", "n_parameters", "number of coded values, masked offsets included"),
        Symbol(r"\mathcal{L}_{\rm rate}", "L_rate", "bits per coded value", "bits"),
        Symbol(r"\lambda_{\rm rate}", "lambda_rate", "weight of the rate", "1 / bits"),
        Symbol(r"\mathcal{L}_{\rm total}", "L_total", "what training minimises"),
    ),
    "Splatting": (
        Symbol(r"\Sigma", "Sigma", "covariances"),
        Symbol("R", "R", "rotations of frames in which the covariances are given"),
        Symbol("W", "W"),
        Symbol("T", "T"),
        Symbol("f_x, f_y", "focal", "focal lengths"),
        Symbol("c_x, c_y", "center"),
        Symbol("", "size"),
        Symbol("", "near", "Gaussians at this depth or nearer are culled", "scene units"),
        Symbol("", "tan_clamp", "clamp of x/z and y/z, relative to the edge of the image"),
        Symbol("", "blur", "added to both variances of a splat", "square pixels"),
        Symbol("", "mean2d", "centres of the splats"),
        Symbol(r"\Sigma_{2D}", "cov2d", "covariances of the splats, as (a, b, c)", "square pixels"),
        Symbol("K", "conic", "their inverses, as (a, b, c) of [[a, b], [b, c]]"),
        Symbol("z", "depth", "distance along the optical axis", "scene units"),
        Symbol("", "visible"),
        Symbol("", "background"),
        Symbol("", "height", "of the image", "pixels"),
        Symbol("", "width", "of the image", "pixels"),
        Symbol("", "occlusion", "False: splats add up and hide nothing"),
        Symbol(r"\alpha_{max}", "alpha_max", "clamp of the opacity of a splat at a pixel"),
        Symbol("T_N", "transmittance", "share of the background that a pixel shows"),
    ),
}
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
# The network's own names, which stand for other symbols, and what only saves time.
LEFT_OUT = {("mlp", "x"), ("mlp", "y"), "weights", "biases", "truth_moments"}

INTRODUCTION = """\
# Glossary of symbols

Letters are those of the paper, and of 3D Gaussian splatting in the last section; where there is
none, the column is empty. A name is that of an argument or a result in the code. A shape names the
axes of an array, whose letters the last table explains; a scalar has none. Where the unit is empty,
the quantity is a plain number. The equation that computes a symbol stands in bold, followed by
those that use it. `python -m tutorials.tools.syllabus index` writes the file, mostly from the
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


def meaning(comment):
    """What a comment says, without shape, unit, choices and additions after a semicolon."""
    text = re.sub(r"^(list of )?\[[^]]*\](, one a level:)?", "", comment)
    text = re.sub(rf" ?\(({'|'.join(UNITS)}|Q\d+)(;[^)]*)?\)", "", text).split(";")[0]
    return re.sub(r", converted to .*|, > 0", "", text).strip()


def row(symbol, places):
    """The cells of a symbol."""
    places = sorted(places, key=lambda place: (not place.computed, not EQUATIONS[place.key].number))
    comments = [place.comment for place in places if place.comment]
    return (
        f"${symbol.letter}$" if symbol.letter else "",
        f"`{symbol.name}`",
        symbol.meaning or next(filter(None, map(meaning, comments)), ""),
        "; ".join(dict.fromkeys(shape for place in places for shape in place.shapes)),
        symbol.unit or next(iter(STATED.findall(" ".join(comments))), ""),
        ", ".join(links(places)),
    )


def links(places):
    """Links to the equations, in bold to those that compute the symbol."""
    made = {}
    for place in places:
        equation = EQUATIONS[place.key]
        number = f"({equation.number})" if equation.number else place.key
        name = number.replace("')", f") {place.key}")  # "3'" is what Eq. (3) says by analogy
        link = f"[{name}](../{equation.module.__name__.replace('.', '/')}.py)"
        made.setdefault(place.key, f"**{link}**" if place.computed else link)
    return made.values()


def glossary():
    """The text of glossary.md."""
    named, text = mentions(), INTRODUCTION
    for title, symbols in SECTIONS.items():
        rows = [row(symbol, named[symbol.name]) for symbol in symbols]
        text += f"\n## {title}\n\n{markdown_table(HEADS, rows)}\n"
    return f"{text}\n## Axes\n\n{markdown_table(('letter', 'counts'), AXES.items())}\n"
