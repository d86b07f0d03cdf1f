"""The pictures of the packaged scenes can be drawn again."""

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.scenes.load import packaged_folder
from tests.golden import tiny_scenes


@pytest.mark.parametrize("name", ["orientation", "figure"])
def test_committed_pixels_can_be_drawn_again(name, tmp_path):
    assert not tiny_scenes.main([name, "-o", str(tmp_path)])
    files = sorted(path.relative_to(tmp_path / name) for path in (tmp_path / name).rglob("*.*"))
    assert len(files) == 58 + 3
    for file in files:
        new, old = tmp_path / name / file, packaged_folder() / name / file
        if file.suffix == ".png":
            difference = np.abs(iio.imread(new).astype(int) - iio.imread(old).astype(int))
            assert difference.max() <= 1, file  # another NumPy may round the last bit otherwise
    assert [file.name for file in (tmp_path / name).iterdir() if file.name[0] == "."] == []
