"""Models and files of both versions: of the paper's alone where the package has no `beyond`."""

import pytest

from p4dgs_ref import designs
from p4dgs_ref.codec import container, file, header
from p4dgs_ref.codec import quantise as paper
from p4dgs_ref.model import Design, Model

VERSIONS = (1, 2) if designs.HAS_OURS else (1,)
NEEDS_OURS = pytest.mark.skipif(not designs.HAS_OURS, reason="the package has no `beyond`")


def design_of(fields):
    """The Design with these fields; with `position_bits` it is the coded one."""
    return (designs.ours("model").Design if "position_bits" in fields else Design)(**fields)


def model_of(design, *arrays, steps=None):
    """The Model of a design; `steps` are those of the coded one."""
    if type(design) is Design:
        return Model(design, *arrays)
    return designs.ours("model").Model(design, *arrays, steps)


def is_ours(model):
    """Whether a model has the coded design."""
    return type(model) is not Model


def quantise(model):
    """The quantised model."""
    return designs.ours("file").quantised(model) if is_ours(model) else paper.quantise(model)


def sections_of(quantised):
    """The sections {name: bytes} of a quantised model."""
    form = (designs.ours("file").FORM,) if is_ours(quantised.model) else ()
    return file.sections_of(quantised, *form)


def write_container(sections, version=1):
    """The file of a version with these sections."""
    return (designs.ours("file") if version == 2 else container).write_container(sections)


def read_header(data, version=1):
    """The design, the number of anchors and the background of a header section."""
    return (designs.ours("file") if version == 2 else header).read_header(data)


def version_of(model):
    """The version of a model's file."""
    return 2 if is_ours(model) else 1
