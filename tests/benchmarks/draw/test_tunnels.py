"""Pictures of linings and the atlas: what they count, and that they are written."""

import json

import numpy as np
from PIL import Image

from benchmarks.draw import atlas, kinds


def test_a_picture_of_a_kind_is_written(tmp_path):
    kinds.run(kinds.KindsConfig(kinds=("cast",), length=24.0, out=tmp_path))
    picture = np.asarray(Image.open(tmp_path / "cast.png").convert("L"))
    assert picture.shape == (400, 880)
    assert picture.std() > 10.0


def test_an_atlas_is_written_with_null_where_walls_tell_nothing(tmp_path, capsys):
    atlas.run(atlas.AtlasConfig("control", step=2.0, out=tmp_path))
    found = json.loads((tmp_path / "atlas.json").read_text())["atlas"]["smooth, planar"]
    inside = [b for s, b in zip(found["station"], found["station_bound"], strict=True) if 40.0 < s < 310.0]
    assert inside
    assert set(inside) == {None}
    assert "nothing in 100 % of the cells" in capsys.readouterr().out
    assert Image.open(tmp_path / "atlas.png").size == (1100, 616)
