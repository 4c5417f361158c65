"""Pictures of bores in three dimensions: where the LiDAR's plane meets the wall, and what a camera in it sees."""

from pathlib import Path

import numpy as np
import pytest

import subterra_jax as st
from benchmarks import linings
from benchmarks.bores import plane_angles, render_bore
from benchmarks.command import BenchmarkError
from subterra_jax.procedural.open_world import plan


def test_the_plane_meets_the_wall_where_the_plan_has_it() -> None:
    tunnel = st.load_tunnel("metro-universal")
    shell = tunnel.shell
    for angle, side in zip(plane_angles(tunnel, shell), ("left", "right"), strict=True):
        radius = np.array(
            [np.interp(a, shell.angle, r, period=2 * np.pi) for a, r in zip(angle, shell.radius, strict=True)]
        )
        wall = getattr(tunnel.lining("smooth"), side)
        centre = np.stack([np.interp(wall.station, tunnel.station, tunnel.centre[:, i]) for i in (0, 1)], axis=1)
        across = np.hypot(*(wall.vertex - centre).T)
        there = np.interp(wall.station, shell.station, np.abs(radius * np.cos(angle)))
        np.testing.assert_allclose(across, there, atol=0.01)


def test_a_tunnel_by_name_is_rolled_out(tmp_path: Path) -> None:
    linings.run(linings.LiningsConfig(tunnels=("metro-universal",), length=24.0, out=tmp_path))
    assert (tmp_path / "metro-universal.png").stat().st_size > 2000


def test_a_tunnel_without_a_bore_is_refused_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match="no bore in three dimensions"):
        linings.run(linings.LiningsConfig(tunnels=("control",), out=tmp_path))


def test_a_rendered_bore_is_dark_in_its_middle_and_light_around() -> None:
    try:
        picture = render_bore(plan("open:universal:test-unseen:900010", length=70.0)).astype(float)
    except st.SubterraError as error:
        pytest.skip(str(error))
    height, width = picture.shape[:2]
    middle = picture[height // 2 - 3 : height // 2 + 3, width // 2 - 3 : width // 2 + 3].mean()
    assert picture.mean() > 60.0
    assert middle < 0.6 * picture.mean()
