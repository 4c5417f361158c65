"""3-D LiDAR: tubes and boxes with known answers, and float64 brute force over every triangle of a rough bend."""

import dataclasses
import re
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import subterra_jax as st
from subterra_jax import lidar3d, native
from subterra_jax.lidar import kernels
from subterra_jax.lidar3d import beams, casting, finding, fused
from subterra_jax.lidar3d.relief import ARRAYS, Relief
from subterra_jax.lidar3d.surface import BOX_CORNERS, BOX_FACES, Axis, Triangles
from tests.subterra_jax import surfaces
from tests.subterra_jax.placing import for_nvidia

RADIUS, LENGTH = 2.0, 60.0
N_SCANS, N_BEAMS = 32, 16


@jax.jit
def device_cast(relief, origin, direction, station, range_max):
    return jax.vmap(surfaces.ranges, (None, 0, 0, 0, None))(relief, origin, direction, station, range_max)


def cast(relief, origin, direction, range_max=30.0, station=None) -> np.ndarray:
    """Ranges of up to 32 scans from origins `(n, 3)`, beams `(n, 16, 3)`; always the same shapes, so one program."""
    origin, direction = np.atleast_2d(origin).astype(np.float32), np.asarray(direction, np.float32)
    n = len(origin)
    station = origin[:, 0] if station is None else np.asarray(station, np.float32)
    rows = np.arange(N_SCANS) % n
    return np.asarray(device_cast(relief, origin[rows], direction[rows], station[rows], range_max))[:n]


def relief_of(axis, surface) -> Relief:
    return Relief.from_triangles(Axis(**axis), Triangles(*surface))


@pytest.fixture(scope="module")
def bend():
    """A rough tube on an arc of 60 m with a grade and steep recesses."""
    axis = surfaces.axis_of(45.0, 1 / 60.0, 0.02)
    radius = RADIUS + np.random.default_rng(0).normal(0.0, 0.02, (91, 40))
    radius[20:22, 3:5] += 0.4
    radius[40:43, 20:22] += 0.3
    return axis, surfaces.tube(axis, radius, 40, 91)


@pytest.fixture(scope="module")
def reliefs(bend):
    """A round tube, the same with a box and a thin post in it, and the bend; all of the same array sizes."""
    axis = surfaces.axis_of(LENGTH)
    round_tube = surfaces.tube(axis, RADIUS, 360, 31)
    things = (surfaces.box((20.0, 0.5, -1.0), (0.25, 0.2, 0.3)), surfaces.box((35.0, 0.0, 0.0), (0.02, 0.02, 1.9)))
    made = [relief_of(axis, round_tube), relief_of(axis, surfaces.together(round_tube, *things)), relief_of(*bend)]
    for name in ARRAYS:  # of the same sizes they share one program
        sizes = np.max([getattr(one, name).shape for one in made], axis=0)
        fill = lambda a, sizes=sizes: jnp.pad(a, [(0, n - m) for n, m in zip(sizes, a.shape, strict=True)])  # noqa: E731
        made = [dataclasses.replace(one, **{name: fill(getattr(one, name))}) for one in made]
    return dict(zip(("tube", "things", "bend"), made, strict=True))


def random_directions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    way = rng.normal(size=(*shape, 3)).astype(np.float32)
    return way / np.linalg.norm(way, axis=-1, keepdims=True)


def test_a_tilted_sensor_off_the_axis_meets_the_tube_where_the_quadratic_says(reliefs):
    rng = np.random.default_rng(1)
    angle = np.deg2rad(rng.uniform(-20, 20, 2))
    turned = Rotation.from_euler("y", angle[0]).apply(beams.planar(N_BEAMS))
    origin = np.array([30.0, 0.7, -0.4])
    ranges = cast(reliefs["tube"], origin, turned[None])[0]
    (_, y, z), (_, dy, dz) = origin, turned.T.astype(float)
    a, b, c = dy**2 + dz**2, y * dy + z * dz, y**2 + z**2 - RADIUS**2
    expected = (-b + np.sqrt(b**2 - a * c)) / np.maximum(a, 1e-12)
    # 360 flat sides are within 0.08 mm of the circle, which a grazing beam makes more of.
    np.testing.assert_allclose(ranges, np.minimum(expected, 30.0), atol=2e-3)


def test_beams_that_leave_by_a_mouth_report_exactly_range_max(reliefs):
    ahead = np.tile(np.float32([1.0, 0.0, 0.0]), (N_BEAMS, 1))
    origins = np.array([[50.0, 0.0, 0.0], [50.0, 1.5, 0.5], [60.3, 0.0, 0.0]])
    assert (cast(reliefs["tube"], origins, np.tile(ahead, (3, 1, 1))) == np.float32(30.0)).all()
    assert (cast(reliefs["tube"], [[9.0, 0.0, 0.0]], -ahead[None], 12.5) == np.float32(12.5)).all()


def test_a_sensor_outside_a_mouth_looks_in(reliefs):
    way = np.array([np.cos(0.3), np.sin(0.3), 0.0], np.float32)
    ranges = cast(reliefs["tube"], [[-0.4, 0.0, 0.0]], np.tile(way, (1, N_BEAMS, 1)))
    np.testing.assert_allclose(ranges, RADIUS / np.sin(0.3), atol=2e-4)


def test_a_box_and_a_thin_post_stand_in_the_way(reliefs):
    ahead = np.tile(np.float32([1.0, 0.0, 0.0]), (2, N_BEAMS, 1))
    origins = np.array([[10.0, 0.5, -1.0], [25.0, 0.005, 1.0]])
    ranges = cast(reliefs["things"], origins, ahead)[:, 0]
    np.testing.assert_allclose(ranges, [20.0 - 0.25 - 10.0, 35.0 - 0.02 - 25.0], atol=1e-5)
    assert (cast(reliefs["tube"], origins, ahead)[:, 0] == 30.0).all()


def test_a_rail_whose_edges_are_not_square_is_met_where_its_faces_are():
    axis, rng = surfaces.axis_of(LENGTH), np.random.default_rng(4)
    rail = BOX_CORNERS * [4.0, 0.035, 0.07]
    rail = rail + [30.0, 0.7, -1.2] + rail[:, :1] * [0.0, 3e-3, 1e-3] + rail[:, 1:2] * [0.05, 0.0, 0.0]
    surface = surfaces.together(surfaces.tube(axis, RADIUS, 60, 31), (rail, BOX_FACES))
    origin = np.float32([[24.0, 0.3, -0.5], [33.0, 1.0, -0.9]])
    end = rail.mean(axis=0) + rng.uniform(-1.0, 1.0, (2, N_BEAMS, 3)) * [4.0, 0.03, 0.06]
    way = end - origin[:, None]
    way = (way / np.linalg.norm(way, axis=-1, keepdims=True)).astype(np.float32)
    ranges = cast(relief_of(axis, surface), origin, way)
    truth = surfaces.brute(surface, np.repeat(origin, N_BEAMS, axis=0), way.reshape(-1, 3))
    np.testing.assert_allclose(ranges.ravel(), truth, atol=2e-4)


def test_a_rough_bend_with_recesses_agrees_with_brute_force_over_every_triangle(bend, reliefs):
    axis, surface = bend
    rng = np.random.default_rng(2)
    pick = rng.integers(2, len(axis["station"]) - 2, N_SCANS)
    origin = (axis["position"][pick] + rng.uniform(-0.8, 0.8, (N_SCANS, 3))).astype(np.float32)
    way = random_directions(rng, N_SCANS, N_BEAMS)
    way[: N_SCANS // 2] *= [1.0, 1.0, 0.1]  # half of them level, so that they go far and graze
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    station = axis["station"][pick] + rng.uniform(-2.0, 2.0, N_SCANS)
    ranges = cast(reliefs["bend"], origin, way, station=station)
    truth = surfaces.brute(surface, np.repeat(origin, N_BEAMS, axis=0), way.reshape(-1, 3))
    error = np.abs(ranges.ravel() - np.minimum(truth, 30.0))
    assert np.median(error) < 1e-5
    assert error.max() < 1e-3
    assert (ranges > 15.0).sum() > 20


def test_a_pose_that_is_no_number_ends_and_gives_no_number(reliefs):
    ranges = cast(reliefs["tube"], [[np.nan, 0.0, 0.0], [30.0, 0.0, 0.0]], np.tile(beams.planar(N_BEAMS), (2, 1, 1)))
    assert np.isnan(ranges[0]).all()
    assert np.isfinite(ranges[1]).all()


def bend_rays(axis, n: int, seed: int):
    """Origins, directions and stations of rays in the bend, half of them nearly level."""
    rng = np.random.default_rng(seed)
    pick = rng.integers(2, len(axis["station"]) - 2, n)
    origin = (axis["position"][pick] + rng.uniform(-0.8, 0.8, (n, 3))).astype(np.float32)
    way = rng.normal(size=(n, 3)) * np.where(np.arange(n)[:, None] % 2, [1.0, 1.0, 1.0], [1.0, 1.0, 0.1])
    way = (way / np.linalg.norm(way, axis=-1, keepdims=True)).astype(np.float32)
    return origin, way, axis["station"][pick].astype(np.float32)


@partial(jax.jit, static_argnums=0)
def found_by(find, relief, origin, way, station):
    """Hits of rays by one of the ways to march them."""
    block = jax.vmap(casting.block_at, (None, 0, 0))(relief, origin, station)
    return find(relief, jnp.asarray(origin), jnp.asarray(way), block, jnp.full(len(origin), 30.0))


@pytest.mark.parametrize("name", [pytest.param("bend", marks=pytest.mark.slow), "things"])
def test_the_fused_kernel_and_xla_meet_the_same_triangles(bend, reliefs, name):
    rays = bend_rays(bend[0] if name == "bend" else surfaces.axis_of(LENGTH), 72, 4)
    finds = (finding.by_xla, fused.find)
    (xla, xla_normal), (kernel, normal) = (found_by(find, reliefs[name], *rays) for find in finds)
    np.testing.assert_array_equal(xla.entry, kernel.entry)
    np.testing.assert_allclose(xla.distance, kernel.distance, rtol=1e-6)
    np.testing.assert_allclose(xla_normal, normal, atol=1e-6)


def test_scans_of_one_place_meet_what_rays_of_a_place_each_meet(reliefs):
    origin, way, station = bend_rays(surfaces.axis_of(LENGTH), 96, 5)
    origin, station, relief = origin[::32], station[::32], reliefs["things"]
    block, limit = jax.vmap(casting.block_at, (None, 0, 0))(relief, origin, station), jnp.full(3, 30.0)
    hits, normal = jax.jit(fused.find)(relief, origin, way.reshape(3, 4, 8, 3), block, limit)
    each, own = found_by(fused.find, relief, np.repeat(origin, 32, 0), way, np.repeat(station, 32))
    for one, other in zip((*hits, *normal), (*each, *own), strict=True):
        np.testing.assert_allclose(np.ravel(one), other, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("image", "tall"), [((4, 8), 4), ((16, 256), 16), ((64, 512), 4), ((3, 64), 1)])
def test_programs_take_each_ray_of_two_images_once_tile_by_tile(image, tall):
    rays = np.asarray(jax.vmap(partial(fused._rays_of, image))(np.arange(2 * image[0] * image[1] // 32)))
    assert np.array_equal(np.sort(rays, axis=None), np.arange(2 * image[0] * image[1]))
    row, column = np.divmod(rays, image[1])
    assert (np.ptp(row, axis=1) == tall - 1).all()
    assert (np.ptp(column, axis=1) == 32 // tall - 1).all()


def test_the_kernel_for_scans_lowers_for_a_gpu_and_serves_a_batch(reliefs, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(kernels, "on_nvidia", lambda: True)

    def ranges(relief, origin, way, station):
        meet = jax.vmap(casting.meet, (None, 0, None, 0, None))
        return meet(relief, origin, way, station, jnp.float32(30.0)).ranges

    rows = (
        jnp.zeros((4, 3)),
        jnp.asarray(beams.spinning(np.linspace(-0.2, 0.2, 2), 32)).reshape(2, 32, 3),
        jnp.full(4, 20.0),
    )
    assert for_nvidia(ranges, reliefs["things"], *rows).count("triton") == 1


@pytest.mark.parametrize("find", [finding.by_xla, fused.find])
def test_normals_are_those_of_the_faces_of_a_box_and_of_the_tube_behind_it(find):
    axis, middle = surfaces.axis_of(LENGTH), np.float32([20.0, 0.5, -1.0])
    box = middle + BOX_CORNERS * [0.25, 0.2, 0.3], BOX_FACES
    relief = relief_of(axis, surfaces.together(surfaces.tube(axis, RADIUS, 360, 31), box))
    side = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    origin = middle + 0.7 * np.concatenate([side, side]) + np.float32([0.013, 0.017, 0.019])
    way = np.concatenate([-side, side])
    hits, normal = found_by(find, relief, origin, way, np.full(12, 20.0, np.float32))
    normal, met = np.transpose(normal), origin + np.minimum(hits.distance, 30.0)[:, None] * way
    assert (np.asarray(hits.entry)[:6] < -1).all()
    np.testing.assert_allclose(np.abs(normal[:6]), np.abs(side), atol=1e-6)
    wall = 6 + np.array([1, 2, 4, 5])
    radial = met[wall] * [0.0, 1.0, 1.0] / np.linalg.norm(met[wall, 1:], axis=1)[:, None]
    np.testing.assert_allclose(np.abs(np.sum(normal[wall] * radial, axis=1)), 1.0, atol=1e-4)
    assert not normal[[6, 9]].any()  # along the tunnel and out of a mouth


@pytest.mark.skipif(not native.supported(), reason="needs numba")
@pytest.mark.parametrize("name", ["bend", "things"])
def test_machine_code_and_xla_give_the_same_ranges(bend, reliefs, name):
    rays = bend_rays(bend[0] if name == "bend" else surfaces.axis_of(LENGTH), 600, 5)
    (xla, _), (code, _) = (found_by(find, reliefs[name], *rays) for find in (finding.by_xla, finding.by_numba))
    np.testing.assert_allclose(np.minimum(xla.distance, 30.0), np.minimum(code.distance, 30.0), atol=2e-5)
    triangle = np.asarray(reliefs[name].entry)
    # A ray may meet one triangle in the list of either of two cells.
    assert (triangle[np.asarray(xla.entry)] == triangle[np.asarray(code.entry)]).mean() > 0.98


@pytest.mark.parametrize("name", ["bend", "things"])
def test_derivatives_are_those_of_finite_differences_off_the_edges(bend, reliefs, name):
    origin, way, station = bend_rays(bend[0] if name == "bend" else surfaces.axis_of(LENGTH), 5000, 8)

    def reach(o, d, s):
        return surfaces.ranges(reliefs[name], o, d[None], s)[0]

    reaches = jax.jit(jax.vmap(reach))
    value = np.asarray(reaches(origin, way, station))
    slopes = [np.asarray(leaf) for leaf in jax.jit(jax.vmap(jax.grad(reach, (0, 1))))(origin, way, station)]
    for which, slope in enumerate(slopes):
        for i in range(3):
            step = 2e-3 * np.eye(3, dtype=np.float32)[i]
            moved = [np.asarray(reaches(origin + e * (1 - which), way + e * which, station)) for e in (step, -step)]
            # Off the edges: the ray stays on one triangle, the range all but linear; float32 leaves some 1e-5 m.
            smooth = (value < 29.0) & (np.abs(moved[0] - 2.0 * value + moved[1]) < 1e-4 * value)
            difference = (moved[0] - moved[1])[smooth] / 4e-3
            error = np.abs(slope[smooth, i] - difference) / (1.0 + np.abs(difference))
            assert smooth.mean() > 0.5
            assert np.median(error) < 2e-3
            assert np.percentile(error, 97.0) < 0.03
    assert not any(slope[value == 30.0].any() for slope in slopes)


def test_the_page_finds_a_pose_by_descending_on_one_scan():
    page = Path(__file__).parents[2] / "docs" / "api" / "lidar3d.md"
    (code,) = [b for b in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL) if "def descend" in b]
    space: dict = {}
    exec(code, space)
    pose, true_pose = np.asarray(space["pose"]), np.asarray(space["true_pose"])
    np.testing.assert_allclose(pose[:3], true_pose[:3], atol=1e-4)
    np.testing.assert_allclose(pose[3:], true_pose[3:], atol=np.deg2rad(1e-3))


def test_an_image_of_beams_has_the_ranges_and_derivatives_of_its_beams(reliefs):
    place = jnp.array([31.0, 0.2, -0.1])
    beam = jnp.asarray(beams.spinning(np.linspace(-0.3, 0.3, 4), 16), jnp.float32)

    def ranges(place, beam):
        origins = place if beam.ndim == 3 else jnp.broadcast_to(place, beam.shape)
        return lidar3d.meet(reliefs["things"], origins, beam, place[0], 30.0).ranges

    image, flat = ranges(place, beam.reshape(4, 16, 3)), ranges(place, beam)
    np.testing.assert_array_equal(image, np.reshape(flat, (4, 16)))
    slopes = [jax.jacfwd(ranges)(place, pattern).reshape(64, 3) for pattern in (beam, beam.reshape(4, 16, 3))]
    assert np.abs(slopes[0]).max() > 0.5
    np.testing.assert_allclose(*slopes, atol=1e-6)


def test_a_sensor_in_a_recess_is_free_and_one_in_the_wall_beside_it_is_not(bend, reliefs):
    axis, row = bend[0], 82  # of 181 stations: the middle of a recess 0.3 m deep, at half a turn
    tangent, turn = axis["tangent"][row], 20.5 * 2.0 * np.pi / 40
    left = np.cross([0.0, 0.0, 1.0], tangent)
    left /= np.linalg.norm(left)
    at = lambda angle: axis["position"][row] + 2.12 * (np.cos(angle) * left + np.sin(angle) * np.cross(tangent, left))  # noqa: E731
    lidar3d.require_free(reliefs["bend"], at(turn), axis["station"][row])
    with pytest.raises(st.SubterraError, match=r"the sensor at .* is inside the wall, or in a thing"):
        lidar3d.require_free(reliefs["bend"], at(turn + 0.6), axis["station"][row])
    for x, y, z, free in ((20.0, 0.5, -1.0, False), (19.7, 0.5, -1.0, True), (20.0, 0.5, -0.65, True)):  # in the box?
        with nullcontext() if free else pytest.raises(st.SubterraError, match="in a thing"):
            lidar3d.require_free(reliefs["things"], (x, y, z), 20.0)
