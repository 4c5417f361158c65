"""The map of a localiser, and how well a scan fits a place, against float64 NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.baselines import scanmodel
from subterra_jax.baselines.scanmodel import ScanModel, TunnelPose
from subterra_jax.baselines.wallmap import wall_map
from subterra_jax.tunnel import at_station
from tests.recorded import check, named
from tests.subterra_jax import tunnels

BEAMS = lidar.LidarParams()
FAR = jnp.float32(30.0)
fit, fit_roughly, endpoints = (jax.jit(getattr(scanmodel, name)) for name in ("fit", "fit_roughly", "endpoints"))


@pytest.fixture(scope="module")
def plan():
    return st.load_tunnel().slice(100.0, 90.0)


@pytest.fixture(scope="module")
def tunnel(plan):
    return st.Tunnel.from_plan(plan, "pockets")


def pose_of(station, lateral, heading) -> TunnelPose:
    return TunnelPose(*(jnp.atleast_1d(jnp.asarray(value, jnp.float32)) for value in (station, lateral, heading)))


@jax.jit
def true_scan(tunnel, station: float, lateral: float, heading: float):
    x, y, tangent_x, tangent_y, _ = at_station(tunnel, jnp.float32(station))
    position = jnp.stack([x - lateral * tangent_y, y + lateral * tangent_x])
    return lidar.scan(tunnel, position, jnp.arctan2(tangent_y, tangent_x) + heading, jnp.float32(station), BEAMS)


def crossing(plan, wall, station: float, side: float) -> float:
    """Return the distance along the centreline's normal to a wall, by brute force over its segments, m."""
    centre, tangent = (
        np.array([np.interp(station, plan.station, values[:, i]) for i in range(2)])
        for values in (plan.centre, plan.tangent)
    )
    normal = side * np.array([-tangent[1], tangent[0]]) / np.linalg.norm(tangent)
    along = (wall.vertex - centre) @ (tangent / np.linalg.norm(tangent))
    out = (wall.vertex - centre) @ normal
    found = [
        o0 + (o1 - o0) * a0 / (a0 - a1)
        for a0, a1, o0, o1 in zip(along[:-1], along[1:], out[:-1], out[1:], strict=True)
        if a0 * a1 < 0.0
    ]
    return min(o for o in found if 0.0 < o < 6.0)


def test_the_map_of_a_bend_knows_its_curvature(plan_of):
    bend = plan_of(tunnels.tunnel_arrays(tunnels.arc(60.0, 150.0), half_width=3.0))
    walls = wall_map(st.Tunnel.from_plan(bend, "smooth"))
    inner = np.asarray(walls.bend)[:, 40:-40]
    np.testing.assert_allclose(inner, 1.0 / 150.0, rtol=0.01)


def test_the_map_is_where_the_normal_of_the_centreline_meets_the_walls(plan, tunnel):
    walls = wall_map(tunnel, blur=1e-3)
    lining, rng = plan.lining("pockets"), np.random.default_rng(0)
    errors = []
    for cell in rng.integers(100, walls.wall.shape[1] - 100, 60):
        station = (cell + 0.5) * float(walls.cell)
        for row, (wall, side) in enumerate(((lining.left, 1.0), (lining.right, -1.0))):
            errors.append(float(walls.wall[row, cell]) - crossing(plan, wall, station, side))
    # A cell in which a pocket begins may be taken for either.
    assert np.mean(np.abs(errors) < 2e-3) > 0.97


def test_a_stack_holds_the_map_of_each_of_its_tunnels(plan):
    alone = [st.Tunnel.from_plan(plan, "pockets"), st.Tunnel.from_plan(plan.slice(20.0, 50.0), "smooth")]
    stack = st.stack(alone)
    walls = wall_map(stack)
    check(__file__, "map", named(walls))
    station, left = jnp.linspace(0.5, 49.5, 40), jnp.arange(40) % 2 == 0
    for index, tunnel in enumerate(alone):
        mine = walls.pick(stack.pick(index))
        expected = wall_map(tunnel).pick(tunnel)
        for got, want in zip(mine.offset(station, left), expected.offset(station, left), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-6)
        np.testing.assert_allclose(mine.curvature(station), expected.curvature(station), atol=1e-7)


def test_endpoints_agree_with_the_exact_geometry_of_the_centreline(plan, tunnel):
    walls = wall_map(tunnel).pick(tunnel)
    rng = np.random.default_rng(1)
    for _ in range(6):
        station, lateral, heading = rng.uniform(10.0, 80.0), rng.uniform(-0.8, 0.8), rng.uniform(-0.3, 0.3)
        ranges = np.asarray(true_scan(tunnel, station, lateral, heading), float)
        ends = endpoints(walls, pose_of(station, lateral, heading), jnp.asarray(ranges, jnp.float32), FAR, ScanModel())
        expected = exact_endpoints(plan, station, lateral, heading, ranges)
        useful = np.asarray(ends.useful)[:, 0]
        assert useful.sum() >= 10
        np.testing.assert_allclose(np.asarray(ends.station)[useful, 0], expected[useful, 0], atol=0.02)
        np.testing.assert_allclose(np.asarray(ends.lateral)[useful, 0], expected[useful, 1], atol=0.01)


def exact_endpoints(plan, station: float, lateral: float, heading: float, ranges: np.ndarray) -> np.ndarray:
    """Station and offset of the endpoints by world coordinates and the nearest point of a fine centreline, float64."""
    fine = np.linspace(0.0, plan.length, 20_001)
    centre = np.stack([np.interp(fine, plan.station, plan.centre[:, i]) for i in range(2)], axis=-1)
    tangent = np.stack([np.interp(fine, plan.station, plan.tangent[:, i]) for i in range(2)], axis=-1)
    here = int(np.argmin(np.abs(fine - station)))
    angle = np.arctan2(tangent[here, 1], tangent[here, 0])
    robot = centre[here] + lateral * np.array([-np.sin(angle), np.cos(angle)])
    bearing = angle + heading + np.arange(len(ranges)) * 2.0 * np.pi / len(ranges)
    found = []
    for reach, direction in zip(ranges, bearing, strict=True):
        point = robot + reach * np.array([np.cos(direction), np.sin(direction)])
        nearest = int(np.argmin(np.sum((centre - point) ** 2, axis=1)))
        off = point - centre[nearest]
        found.append((fine[nearest], tangent[nearest, 0] * off[1] - tangent[nearest, 1] * off[0]))
    return np.array(found)


def test_the_likelihood_equals_a_float64_reference(tunnel):
    walls, model = wall_map(tunnel).pick(tunnel), ScanModel()
    ranges = true_scan(tunnel, 40.0, 0.2, 0.05)
    pose = pose_of([40.0, 40.2, 40.6, 45.0], [0.2, 0.21, 0.2, 0.18], [0.05, 0.05, 0.045, 0.05])
    got, adjusted = fit(walls, pose, ranges, FAR, model)
    ends = endpoints(walls, pose, ranges, FAR, model)
    for i in range(4):
        score, shift, turn = reference_fit(walls, ends, i, model)
        assert float(got[i]) == pytest.approx(score, abs=2e-2)
        assert float(adjusted.lateral[i] - pose.lateral[i]) == pytest.approx(shift, abs=1e-5)
        assert float(adjusted.heading[i] - pose.heading[i]) == pytest.approx(turn, abs=1e-5)


def reference_fit(walls, ends, i: int, model: ScanModel) -> tuple[float, float, float]:
    """One place by NumPy: weighted least squares as a linear system, then the log of the mixture."""
    station, lateral, along, sigma = (
        np.asarray(values, float)[:, i] for values in (ends.station, ends.lateral, ends.along, ends.sigma)
    )
    useful, cell = np.asarray(ends.useful)[:, i], np.floor(station / float(walls.cell)).astype(int)
    row = np.where(lateral > 0.0, 0, 1)
    cell = np.clip(cell, 0, int(walls.n_cells) - 1)
    wall, spread = np.asarray(walls.wall, float)[row, cell], np.asarray(walls.spread, float)[row, cell]
    residual = lateral - np.where(row == 0, wall, -wall)
    variance = sigma**2 + spread
    weight = np.where(useful, 1.0 / (variance * (1.0 + residual**2 / variance / 6.0)), 0.0)
    rows = np.stack([np.ones_like(along), along])
    prior = np.diag([model.lateral_sigma**-2, model.heading_sigma**-2])
    shift, turn = np.linalg.solve((rows * weight) @ rows.T + prior, -(rows * weight) @ residual)
    residual = residual + shift + along * turn
    normal = np.exp(-0.5 * residual**2 / variance) / np.sqrt(2.0 * np.pi * variance)
    each = np.log((1.0 - model.outlier_fraction) * normal + model.outlier_fraction * model.outlier_density)
    drawn = (shift / model.lateral_sigma) ** 2 + (turn / model.heading_sigma) ** 2
    return model.power * (each[useful].sum() - 0.5 * drawn), shift, turn


def test_a_first_look_finds_offset_and_heading(tunnel):
    walls = wall_map(tunnel).pick(tunnel)
    for lateral, heading in ((0.5, 0.1), (-0.5, 0.1), (0.45, -0.1), (-0.3, -0.05)):
        ranges = true_scan(tunnel, 30.0, lateral, heading)
        found = fit_roughly(walls, pose_of(30.0, 0.0, 0.0), ranges, FAR, ScanModel())
        assert float(found.lateral[0]) == pytest.approx(lateral, abs=0.03)
        assert float(found.heading[0]) == pytest.approx(heading, abs=0.01)


@pytest.mark.parametrize(("station", "elsewhere"), [(12.0, 2.0), (1.0, 30.0)], ids=["echo beyond a mouth", "no echo"])
def test_a_scan_that_a_place_cannot_give_speaks_against_it(tunnel, station, elsewhere):
    ranges = true_scan(tunnel, station, 0.0, 0.0)  # at 1 m the beams behind leave through the mouth
    pose = pose_of([station, elsewhere], [0.0, 0.0], [0.0, 0.0])
    here, there = fit(wall_map(tunnel).pick(tunnel), pose, ranges, FAR, ScanModel())[0]
    assert float(here - there) > 5.0
