"""Which tutorial explains which equation."""

from typing import NamedTuple


class Tutorial(NamedTuple):
    """One file of tutorials/."""

    name: str
    keys: tuple = ()  # of the equations that it explains
    lit: tuple = ()  # boxes of the drawing that it lights, where they are not those of `keys`


TUTORIALS = (
    Tutorial("01_offsets", ("offsets",)),
    Tutorial("02_view", ("view",)),
    Tutorial("03_opacity_and_masking", ("opacity", "masking", "mlp")),
    Tutorial("04_color_rotation_scale", ("color", "rotation", "scale")),
    Tutorial("05_positional_encoding_and_deformation", ("positional_encoding", "deformation")),
    Tutorial("06_deformed", ("deformed",)),
    Tutorial("07_noise_and_rounding", ("noise", "rounding")),
    Tutorial("08_step", ("step",)),
    Tutorial("09_hash_grid", ("hash_grid",)),
    Tutorial("10_prior_and_likelihood", ("likelihood", "prior")),
    Tutorial("11_rate", ("anchor_rate", "hash_rate", "rate_loss")),
    Tutorial("12_losses", ("total_loss", "render_loss", "ssim")),
    Tutorial("13_covariance", ("covariance",)),
    Tutorial("14_projection", ("projection",)),
    Tutorial("15_compositing", ("compositing",)),
    Tutorial("16_pipeline_by_hand"),
    Tutorial(
        "17_four_stages",
        lit=(
            "deformation",
            "deformed",
            "noise",
            "step",
            "hash_grid",
            "prior",
            "likelihood",
            "rate_loss",
            "total_loss",
        ),
    ),
    Tutorial("18_one_training_step", lit=("noise", "render_loss", "rate_loss", "total_loss")),
    Tutorial("19_file_byte_by_byte", lit=("rounding", "entropy_coder", "file")),
    Tutorial("20_intervals_to_rans", lit=("likelihood", "entropy_coder", "file")),
    Tutorial("21_desync", lit=("hash_grid", "prior", "entropy_coder")),
    Tutorial(
        "22_five_questions_about_bits",
        lit=("noise", "rounding", "step", "likelihood", "anchor_rate", "hash_rate"),
    ),
    Tutorial("23_accuracy_versus_time", lit=("compositing", "likelihood")),
    Tutorial(
        "24_hard_cases",
        lit=("step", "likelihood", "hash_rate", "ssim", "projection", "compositing"),
    ),
    Tutorial("25_effects", lit=("view", "color", "deformation", "deformed", "compositing")),
    Tutorial("26_video_codec_analogy"),
    Tutorial("27_rate_distortion", lit=("total_loss", "rate_loss", "file")),
    Tutorial("28_four_ways_to_move", lit=("offsets", "deformation", "deformed", "file")),
    Tutorial(
        "29_porting_in_an_afternoon",
        lit=("rounding", "hash_grid", "projection", "compositing", "entropy_coder", "file"),
    ),
)


def tutorial_of(key):
    """The tutorial that explains an equation."""
    return next(tutorial for tutorial in TUTORIALS if key in tutorial.keys)
