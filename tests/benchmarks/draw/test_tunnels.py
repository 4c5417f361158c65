"""Pictures of linings are written."""

import numpy as np
from PIL import Image

from benchmarks.draw import kinds


def test_a_picture_of_a_kind_is_written(tmp_path):
    kinds.run(kinds.KindsConfig(kinds=("cast",), length=24.0, out=tmp_path))
    picture = np.asarray(Image.open(tmp_path / "cast.png").convert("L"))
    assert picture.shape == (400, 880)
    assert picture.std() > 10.0
