import numpy as np
import pytest

from scene.writing.mesh import as_trimesh, build_solid, open_lining, split_lining


@pytest.fixture(scope="module")
def solid(bore):
    return as_trimesh(build_solid(bore, pockets=True))


def test_the_solid_is_watertight_and_wound_outwards(solid):
    assert solid.is_volume
    assert solid.euler_number == 2


def test_its_volume_is_the_area_of_the_section_times_the_length_and_the_pockets(bore, solid):
    smooth = as_trimesh(build_solid(bore, pockets=False))
    x, y = bore.radius[0] * np.cos(bore.angle), bore.radius[0] * np.sin(bore.angle)
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert smooth.volume == pytest.approx(area * bore.length, rel=2e-3)
    pockets = sum(p["length"] * p["width"] * p["depth"] for p in bore.pocket)
    assert solid.volume - smooth.volume == pytest.approx(pockets, rel=0.03)


def test_the_lining_is_open_at_both_mouths_and_faces_the_axis(bore, solid):
    lining = open_lining(solid, bore)
    for end in (0, -1):
        flush = np.abs((lining.triangles_center - bore.position[end]) @ bore.tangent[end]) < 1e-3
        assert not flush.any()
    assert not lining.is_watertight
    station, lateral, up = bore.axis.local(lining.triangles_center)
    outward = lateral[:, None] * bore.axis.at(station).lateral + up[:, None] * bore.axis.at(station).up
    facing = np.einsum("ij,ij->i", lining.face_normals, outward) < 0
    assert (lining.area_faces[facing].sum() / lining.area) > 0.98


def test_a_ray_into_a_pocket_goes_13_cm_further(bore, solid):
    pocket = bore.pocket[0]
    at = bore.axis.at(np.array([pocket["station"]]))
    height = np.sin(pocket["angle"]) * np.interp(pocket["angle"], bore.angle, bore.radius[0])
    origin = at.position[0] + height * at.up[0]
    inside, beside = (
        np.linalg.norm(solid.ray.intersects_location([start], [at.lateral[0]])[0][0] - start)
        for start in (origin, origin - 0.4 * at.tangent[0])
    )
    assert inside - beside == pytest.approx(0.13, abs=0.015)


def test_chunks_hold_every_face_once(bore, solid):
    lining = open_lining(solid, bore)
    parts = split_lining(lining, bore, 5.0)
    assert len(parts) > 3
    assert sum(len(part.faces) for part in parts) == len(lining.faces)
    assert sum(part.area for part in parts) == pytest.approx(lining.area)
