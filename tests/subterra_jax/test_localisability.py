"""Information of scans about the pose: against analytic answers, and against float64 casts of random poses."""

import dataclasses

import jax
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.evaluation import floor
from subterra_jax.evaluation.localisability import Solid, localisability, marginal_bound, scan_information
from subterra_jax.lidar import scan
from subterra_jax.lidar3d import Relief, beams
from subterra_jax.tunnel import beside, from_centreline

SIGMA, BLUR, TURN, STEP = 0.05, 0.05, 0.02, 0.025
TASK = "Subterra/StopAt-v1"


def corridor(pockets: bool, bend: float = 0.0) -> st.TunnelPlan:
    """80 m, straight or bent, with a pocket every 1.5 m on the left, or none."""
    station = np.arange(0.0, 80.05, 0.1)
    heading = bend * station
    xy = np.concatenate([[[0.0, 0.0]], np.cumsum(0.1 * np.stack([np.cos(heading), np.sin(heading)], -1)[:-1], axis=0)])
    rows = [(s, 1.0, 0.3, 0.12) for s in np.arange(6.0, 74.0, 1.5)] if pockets else ()
    return from_centreline(xy, 2.5, pockets=rows)


@pytest.fixture(scope="module")
def params():
    return {pockets: st.make(TASK, tunnel=corridor(pockets), goal=_near())[1] for pockets in (False, True)}


@pytest.fixture(scope="module")
def found(params):
    return {pockets: localisability(params[pockets]) for pockets in params}


def inner(found) -> np.ndarray:
    return (found.station > 32.0) & (found.station < 48.0)


def test_a_slope_counts_its_square_over_the_noise():
    station = STEP * np.arange(81)
    ranges = np.stack([3.0 + 0.4 * station, 5.0 - 0.1 * station], axis=-1)
    shifted = [ranges + move * np.array([1.0, -1.0]) * BLUR for move in (1.0, -1.0)]
    turned = [ranges + move * np.array([2.0, 0.5]) * TURN for move in (1.0, -1.0)]
    information = scan_information([ranges, *shifted, *turned], STEP, BLUR, TURN, SIGMA)[40]
    slope = np.array([[0.4, 1.0, 2.0], [-0.1, -1.0, 0.5]])
    np.testing.assert_allclose(information, slope.T @ slope / SIGMA**2, rtol=1e-6)


def test_a_jump_counts_as_the_straight_line_through_poses_about_it():
    station = STEP * np.arange(-60, 61)
    jump = np.where(station > 0.0, 0.3, 0.0)[:, None] + 4.0
    information = scan_information([jump] * 5, STEP, BLUR, TURN, SIGMA)[:, 0, 0]
    noise = BLUR * np.random.default_rng(0).standard_normal(400_000)
    for at in (0.0, 0.05):
        seen = np.where(at + noise > 0.5 * STEP, 0.3, 0.0)  # the jump lies between two of the stations
        slope = np.mean(seen * noise) / BLUR**2
        left_over = seen.var() - slope**2 * BLUR**2
        row = np.argmin(np.abs(station - at))
        # The jump of a grid is a ramp of half a blur.
        assert information[row] == pytest.approx(slope**2 / (SIGMA**2 + left_over), rel=0.06)
    assert information[0] == 0.0


def test_a_wall_without_landmarks_tells_no_station_and_pockets_do(found):
    for bend in (0.0, 1.0 / 300.0):
        smooth = localisability(st.make(TASK, tunnel=corridor(False, bend), goal=_near())[1]) if bend else found[False]
        assert np.all(np.isinf(smooth.station_bound[inner(smooth)]))
        assert np.min(smooth.station_bound[:16]) < 0.5, "a mouth is seen"
        assert np.all(smooth.offset_bound < 0.05)
        assert np.all(smooth.heading_bound < 0.05)
    pockets = found[True]
    assert np.all(pockets.station_bound[inner(pockets)] < 0.3)
    assert pockets.drift[inner(pockets)].max() < 0.1 < 0.3 < found[False].drift[inner(pockets)].max()


def test_the_control_tunnel_of_the_benchmark_tells_nothing_away_from_its_mouths():
    found = localisability(st.make(TASK, tunnel="control")[1], step=1.0)
    inside = (found.station > 35.0) & (found.station < 316.0)
    assert np.all(np.isinf(found.station_bound[inside]))
    assert np.isfinite(found.station_bound[:16]).any()
    assert np.isfinite(found.station_bound[-16:]).any()
    deep = (found.station > 290.0) & (found.station < 310.0)
    assert np.all(found.drift[deep] > 0.5 * found.blind_drift[deep])


def test_information_agrees_with_float64_casts_of_random_poses(params, found):
    """Straight lines fitted to reference scans of normally distributed poses, beam by beam."""
    plan, rng, n = corridor(True), np.random.default_rng(3), 1500
    segments = plan.lining("pockets").segments
    for cell in (70, 71):
        low, high = (found[True].station[cell] + side * 0.25 for side in (-1.0, 1.0))
        own = []
        for at in np.linspace(low, high, 12):
            noise = BLUR * rng.standard_normal(n)
            noise -= noise.mean()
            seen = reference.scan(segments, np.stack([at + noise, np.zeros(n)], -1), np.zeros(n))
            slope = noise @ seen / (noise @ noise)
            left_over = np.var(seen - np.outer(noise, slope), axis=0)
            own.append(np.sum(np.where(np.abs(slope) < 0.02, 0.0, slope) ** 2 / (SIGMA**2 + left_over)))
        assert found[True].information[cell, 0, 0] == pytest.approx(np.mean(own), rel=0.12)


def test_slopes_over_offset_and_heading_are_those_of_finite_differences(found):
    plan = corridor(False)
    segments, at = plan.lining("smooth").segments, found[False].station[80]
    slope = []
    for offset, turn in ((1e-4, 0.0), (0.0, 1e-4)):
        scans = [
            reference.scan(segments, np.array([[at, side * offset]]), np.array([side * turn]))[0]
            for side in (1.0, -1.0)
        ]
        slope.append((scans[0] - scans[1]) / 2e-4)
    information = np.einsum("ib,jb->ij", slope, slope) / SIGMA**2
    np.testing.assert_allclose(found[False].information[80, 1:, 1:], information, rtol=0.02, atol=1.0)


def test_information_falls_with_the_square_of_the_noise(params, found):
    noisy = params[True].replace(lidar=params[True].lidar.replace(range_sigma=0.1))
    twice = localisability(noisy)
    cells = inner(twice)
    # What lies beside a straight line is noise as well, so that less than a factor of four is lost.
    ratio = found[True].information[cells, 0, 0] / twice.information[cells, 0, 0]
    assert np.all((ratio > 1.5) & (ratio <= 4.0 + 1e-6))
    np.testing.assert_allclose(found[False].information[80, 1, 1] * 0.25, localisability(
        params[False].replace(lidar=params[False].lidar.replace(range_sigma=0.1))
    ).information[80, 1, 1], rtol=1e-3)  # fmt: skip


def test_a_filter_without_scans_keeps_the_drift_of_the_closed_form_and_scans_pull_it_in(params):
    station = np.arange(2.0, 79.0)
    blind = floor.filter_variance(station, np.zeros(len(station)), params[True])
    np.testing.assert_allclose(blind, floor.way_out_variance(station, params[True]), rtol=0.02)
    # One scan of 10 cm a step, and nearly nothing else to go by: sigma² / n.
    steps = [floor.filter_variance(station, np.full(len(station), told), params[True]) for told in (1.0, 100.0)]
    assert np.all(steps[1][5:] < steps[0][5:])
    assert np.all(steps[0][5:] < blind[5:])
    hidden = params[True].replace(start=params[True].start.replace(station_sigma=3.0))
    first = floor.filter_variance(np.array([0.0, 0.5, 60.0]), np.full(3, 1.0), hidden)
    # 2.5 scans of 1 m in the first half metre against a prior of 3 m.
    assert first[0] == pytest.approx(9.0)
    assert first[1] == pytest.approx(1.0 / (1.0 / 9.0 + 2.5), rel=0.01)


def test_the_bound_of_one_unknown_leaves_the_others_free():
    information = np.array([[[4.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 1.0]]])
    for i in range(3):
        assert marginal_bound(information, i)[0] == pytest.approx(np.linalg.inv(information[0])[i, i] ** 0.5)


def test_a_long_cell_is_told_what_its_scans_tell_in_the_mean():
    """The walls of the real metro narrow near its mouth: a pose for all of 5 m would be told 30 times as much."""
    plan = st.load_tunnel("metro").slice(0.0, 60.0)
    params = st.make(TASK, tunnel=plan, lining="smooth", goal=_near())[1]
    short, long = (localisability(params, step=step) for step in (0.5, 5.0))
    told = (short.station_bound**-2.0).reshape(-1, 10).mean(axis=1)
    np.testing.assert_allclose(long.station_bound[2:6] ** -2.0, told[2:6], rtol=0.05)
    one_pose = marginal_bound(long.information, 0)
    assert np.all(one_pose[2:5] < 0.5 * long.station_bound[2:5]), "this wall does not try the order of the means"


@pytest.mark.slow
def test_level_beams_in_three_dimensions_tell_what_planar_ones_tell(found, params):
    plan = corridor(True).slice(20.0, 30.0)
    planar = localisability(st.make("Subterra/StopAtShort-v1", tunnel=dataclasses.replace(plan), goal=_near())[1])
    env_params = st.make("Subterra/StopAtShort-v1", tunnel=plan, goal=_near())[1]
    solid = localisability(env_params, solid=Solid(Relief.from_plan(plan), plan, beams.planar(16)))
    np.testing.assert_allclose(solid.information[10:50, 0, 0], planar.information[10:50, 0, 0], rtol=0.05)


def _near() -> st.rules.GoalParams:
    return st.rules.GoalParams(low=5.0, high=20.0, margin=10.0)


def test_what_cannot_be_asked_is_refused(params):
    with pytest.raises(ValueError, match="no tunnel 1 in a stack of 1"):
        localisability(params[True], index=1)
    with pytest.raises(ValueError, match=r"blur=0 m and step=0\.5 m"):
        localisability(params[True], blur=0.0)


def test_a_scan_tells_a_filter_that_knows_less_what_its_own_spread_leaves_of_an_edge(params):
    station = np.arange(2.0, 79.0)
    # Edges tell a filter that knows its place to 5 cm a lot, and one that knows it to 40 cm nothing.
    told = np.tile([400.0, 0.0], (len(station), 1))
    wide = params[True].replace(start=params[True].start.replace(station_sigma=3.0))
    for at, of in ((params[True], True), (wide, False)):
        found = floor.filter_variance(station, told, at, (0.05, 0.4))
        sharp, blind = (floor.filter_variance(station, column, at) for column in told.T)
        assert (found[-1] < 0.5 * blind[-1]) == of, "whoever begins lost stays lost"
        assert np.all(found >= sharp - 1e-12)
    between = floor.filter_variance(np.array([0.0, 0.5, 1.0]), np.tile([8.0, 4.0], (3, 1)), wide, (1.5, 6.0))
    first = floor.filter_variance(np.array([0.0, 0.5, 1.0]), np.full(3, 6.0), wide)
    assert between[1] == pytest.approx(first[1], rel=1e-3), "half way in the log between two blurs"


def test_the_drift_of_a_perfect_filter_takes_each_scan_as_blurred_as_the_filter_is(params, found):
    # Alone in a smooth corridor with edges that stand far apart, it may not read them as if it knew where it was.
    one = found[True]
    sharp = np.sqrt(floor.filter_variance(one.station, one.station_bound**-2.0, params[True]))
    assert np.all(one.drift >= sharp - 1e-9)
    hidden = params[True].replace(start=params[True].start.replace(station_sigma=3.0))
    lost = localisability(hidden)
    naive = np.sqrt(floor.filter_variance(lost.station, lost.station_bound**-2.0, hidden))
    at = np.searchsorted(lost.station, 33.0)
    assert lost.drift[at] > naive[at]


def test_in_a_bend_a_scan_tells_as_much_as_another_place_differs_once_offset_and_heading_are_fitted():
    _, params = st.make("Subterra/StopAt-v1", tunnel="metro", lining="smooth")
    station, shift = np.arange(100.0, 132.0, 0.5, dtype=np.float32), 0.8

    @jax.jit
    def cast(at, offset, heading):
        def one(at, offset, heading):
            place, ahead = beside(params.tunnel, at, offset)
            return scan(params.tunnel, place, ahead + heading, at, params.lidar)

        return jax.vmap(one)(at, offset, heading)

    offset, heading = np.zeros_like(station), np.zeros_like(station)
    here = np.asarray(cast(station, offset, heading), np.float64)
    least = np.full(len(station), np.inf)
    for _ in range(4):
        there = lambda o, h: np.asarray(cast(station + shift, np.float32(o), np.float32(h)), np.float64)  # noqa: E731
        other = there(offset, heading)
        seen = (here < 29.9) & (other < 29.9)
        rest = np.where(seen, other - here, 0.0)
        least = np.minimum(least, (rest**2).sum(axis=1) / SIGMA**2)
        slopes = [
            np.where(seen, (there(offset + a, heading + b) - there(offset - a, heading - b)) / (2.0 * (a + b)), 0.0)
            for a, b in ((1e-3, 0.0), (0.0, 3e-4))
        ]
        for i, jacobian in enumerate(np.stack(slopes, axis=-1)):
            weight = 1.0 / (1.0 + (rest[i] / (3.0 * SIGMA)) ** 2)
            step = np.linalg.lstsq(jacobian * weight[:, None] ** 0.5, -rest[i] * weight**0.5, rcond=None)[0]
            offset[i], heading[i] = offset[i] + step[0], heading[i] + step[1]
    differs = float(np.mean(least) ** -0.5 * shift)
    cells = localisability(params, step=5.0, blur=0.4).station_bound[20:26]
    assert float(np.mean(cells**-2.0) ** -0.5) == pytest.approx(differs, rel=0.15)
