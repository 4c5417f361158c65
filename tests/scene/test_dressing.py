"""What a scene looks like: pictures, lamps, cameras, skins."""

import mujoco
import numpy as np
import pytest

from scene.writing.mesh import as_trimesh, build_solid, has_rings, open_lining, split_skin
from scene.writing.mjcf import concrete_picture


@pytest.fixture(scope="module")
def written(bore, arc_scene):
    lining = open_lining(as_trimesh(build_solid(bore, pockets=True)), bore)
    return arc_scene[1], lining, mujoco.MjModel.from_xml_path(str(arc_scene[0] / "scene.xml"))


def test_joints_are_dark_lines_where_there_are_rings_and_only_there():
    with_rings, without = (concrete_picture(rings, 128, 512).astype(float).mean(axis=(1, 2)) for rings in (True, False))
    assert np.argsort(with_rings)[:2].tolist() in ([0, 64], [64, 0], [0, 127], [0, 1])
    assert with_rings.min() < with_rings.mean() - 20
    assert without.min() > without.mean() - 15


def test_skins_hold_every_face_once_and_the_floor_is_the_floor(bore, written):
    laid, lining, _ = written
    parts = split_skin(lining, bore, laid.bed)
    assert set(parts) == {"lining", "recess", "floor"}
    assert sum(len(part.faces) for part, _ in parts.values()) == len(lining.faces)
    floor = parts["floor"][0]
    assert floor.area == pytest.approx(2 * 2.8 * bore.length, rel=0.03)
    assert parts["recess"][0].area == pytest.approx(len(bore.pocket) * (0.2 * 0.16 + 2 * 0.36 * 0.13), rel=0.05)


def test_texture_coordinates_run_once_around_without_a_jump_inside_a_face(bore, written):
    laid, lining, _ = written
    texture_at, corner = split_skin(lining, bore, laid.bed)["lining"][1]
    assert np.ptp(texture_at[corner], axis=1).max() < 0.3
    assert np.ptp(texture_at[corner][..., 0]) == pytest.approx(1.0, abs=0.05)


def test_stations_of_surveyed_rings_are_no_joints(bore):
    from dataclasses import replace

    assert has_rings(replace(bore, ring_station=np.arange(1.0, 20.0, 1.5)))
    assert not has_rings(replace(bore, ring_station=np.arange(1.0, 24.0, 5.0)))
    assert not has_rings(replace(bore, ring_station=np.empty(0)))
