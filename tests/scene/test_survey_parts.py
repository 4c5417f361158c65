"""The parts of a simulated survey, one by one: pattern, errors, sizes within tolerance."""

from dataclasses import fields, replace

import numpy as np
import pytest

from scene.survey.alignment import draw_railway, lay_out
from scene.survey.bore import draw_bore
from scene.survey.carrier import IMUS
from scene.survey.cast import PULSE, Caster, Hits, Loaded, draw_returns, mix_pixels, noise_sigma
from scene.survey.config import SensorErrors
from scene.survey.furniture import DESIGN, TOLERANCE, draw_sizes
from scene.survey.lidar import AVIA_POINT_RATE, Lidar, avia, avia_directions, os1, vlp16
from scene.survey.mesh import Mesh, Part
from scene.survey.section import draw_field


def test_the_pattern_fills_its_field_of_view_and_no_more() -> None:
    ray = avia_directions(np.arange(2 * AVIA_POINT_RATE) / AVIA_POINT_RATE, np.array([0.3, 1.1]))
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, atol=1e-12)
    across, upright = np.rad2deg([abs(np.arctan2(ray[:, 1], ray[:, 0])).max(), abs(np.arcsin(ray[:, 2])).max()])
    assert 35.0 < across <= 35.2
    assert 38.4 < upright <= 38.6


@pytest.mark.parametrize("seed", range(6))
def test_the_centreline_bends_as_a_railway_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    alignment = lay_out(rng, 200.0, draw_railway(rng, 200.0))
    s = np.arange(0.0, 200.0, 0.1)
    frames = alignment.frames(s)
    np.testing.assert_allclose(np.gradient(frames.position, 0.1, axis=0)[1:-1], frames.tangent[1:-1], atol=3e-5)
    np.testing.assert_allclose(np.einsum("nij,nik->njk", frames.matrix, frames.matrix) - np.eye(3), 0.0, atol=1e-12)
    assert abs(frames.tangent[:, 2]).max() <= 0.01
    curvature = np.gradient(alignment.heading(s), 0.1)
    assert 1 / 401 < abs(curvature).max() < 1 / 149
    assert abs(np.diff(curvature)).max() < 1e-4  # no jump from straight to arc


NEAR, FAR = 5.0, 5.3  # m: two walls across the x axis, with an edge at y = 0


def two_walls() -> Loaded:
    """For y > 0 at `NEAR`, else at `FAR`; seen from the origin."""
    corners = [(x, y, z) for x, y0, y1 in ((NEAR, 0, 50), (FAR, -50, 50)) for y in (y0, y1) for z in (-50, 50)]
    faces = np.array([(0, 2, 1), (1, 2, 3), (4, 6, 5), (5, 6, 7)])[:, ::-1]
    mesh = Mesh(np.array(corners, float), faces, np.full(4, Part.LINING, np.uint8), np.zeros(4))
    return Caster(mesh).load(0.0, np.zeros(3))


def looked(walls: Loaded, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, Hits]:
    """Rays from the origin to `y` on the near wall's plane."""
    ray = np.stack([np.full_like(y, NEAR), y, np.full_like(y, 0.01)], axis=-1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    origin = np.zeros_like(ray)
    return origin, ray, walls.cast(origin, ray)


def hits(distance: float, cosine: float, n: int) -> Hits:
    full = [np.full(n, v, np.float32) for v in (distance, cosine)]
    return Hits(*full, np.full(n, Part.LINING, np.uint8), np.zeros((n, 3), np.float32))


def mix(fraction: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reported and true distances along x of beams at `y`, m."""
    walls, lidar = two_walls(), os1()
    origin, ray, seen = looked(walls, y)
    distance = mix_pixels(np.random.default_rng(3), lidar, fraction, walls, origin, ray, seen)
    return distance * ray[:, 0], seen.distance * ray[:, 0]


def test_mixed_pixels_lie_between_the_two_surfaces_of_an_edge_and_nowhere_else() -> None:
    rim = NEAR * np.tan(os1().divergence)
    reported, true = mix(1.0, np.linspace(-3.0 * rim, 3.0 * rim, 60_001))
    moved = abs(reported - true) > 1e-6
    assert ((reported[moved] > NEAR) & (reported[moved] < FAR)).all()
    at = np.linspace(-3.0, 3.0, 60_001)[moved]
    # The far wall is met behind the edge: a beam that misses the near wall still grazes it up to one rim away.
    assert abs(at).max() < 1.07
    # Evenly between the walls.
    assert reported[moved].mean() == pytest.approx(0.5 * (NEAR + FAR), abs=3 * 0.3 / np.sqrt(12 * moved.sum()))


def test_surfaces_further_apart_than_a_pulse_do_not_mix() -> None:
    walls = two_walls()
    # From 20 m to the side, the far wall's grazing continuation is beyond the pulse.
    origin, ray, _ = looked(walls, np.full(2000, 1e-6))
    back = origin + np.array([0.0, -20.0, 0.0])
    ray = np.array([NEAR, 20.0 + 1e-6, 0.0]) / np.hypot(NEAR, 20.0) + 0 * ray
    seen = walls.cast(back, ray)
    reported = mix_pixels(np.random.default_rng(0), os1(), 1.0, walls, back, ray, seen)
    np.testing.assert_array_equal(reported, seen.distance)
    assert (FAR - NEAR) / NEAR * np.hypot(NEAR, 20.0) > PULSE


@pytest.mark.parametrize("lidar", [avia(), vlp16(), os1()], ids=lambda lidar: lidar.name)
def test_echoes_too_weak_are_lost_and_can_be_kept(lidar: Lidar) -> None:
    rng, n = np.random.default_rng(0), 4000

    def fraction(errors: SensorErrors, distance: float, cosine: float) -> float:
        return draw_returns(rng, lidar, errors, hits(distance, cosine, n)).mean()

    given = SensorErrors()
    middle = (0.3 * 2.8 / lidar.weakest_echo) ** (1 / 3)
    far = 2.0 * middle
    assert fraction(given, 5.0, 0.8) > 0.99
    assert fraction(given, far, 2.8 / far) < 0.01
    assert fraction(given, middle, 2.8 / middle) == pytest.approx(0.498, abs=3 * 0.5 / np.sqrt(n))
    all_kept = replace(given, weak_echoes=False, lost=0.0)
    assert fraction(all_kept, far, 2.8 / far) == 1.0
    some = replace(given, weak_echoes=False, lost=0.1)
    assert fraction(some, far, 2.8 / far) == pytest.approx(0.9, abs=3 * np.sqrt(0.09 / n))
    for place in ((5.0, -0.5), (lidar.range_max + 1, 1.0), (np.inf, 1.0), (0.2, 1.0)):
        assert fraction(all_kept, *place) == 0.0


def test_a_field_has_the_spread_and_correlation_asked_for() -> None:
    rng = np.random.default_rng(1)
    at = np.array([0.0, 10.0])
    values = np.array([draw_field(rng, 0.05, 10.0).along(at) for _ in range(4000)])
    assert values.std() == pytest.approx(0.05, rel=0.03)
    assert np.corrcoef(values.T)[0, 1] == pytest.approx(np.exp(-1.0), abs=0.04)


def test_range_noise_grows_with_range_and_incidence() -> None:
    def sigma(distance: float, cosine: float) -> float:
        one = [np.array([v], np.float32) for v in (distance, cosine)]
        return float(noise_sigma(SensorErrors(), *one)[0])

    assert sigma(0.0, 1.0) == pytest.approx(0.019)
    assert sigma(50.0, 1.0) == pytest.approx(np.hypot(0.019, 0.005))
    assert sigma(0.0, np.sqrt(0.5)) == pytest.approx(np.hypot(0.019, 0.002))
    # The tangent stops at 10.
    assert sigma(0.0, 0.01) == sigma(0.0, 0.05) == pytest.approx(np.hypot(0.019, 0.02))
    assert noise_sigma(SensorErrors(), np.full(1, np.inf, np.float32), np.zeros(1, np.float32))[0] < 0.03


def test_every_imu_is_mounted_by_a_rotation() -> None:
    for imus in IMUS.values():
        for imu in imus:
            np.testing.assert_allclose(imu.mount.rotation @ imu.mount.rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(imu.mount.rotation) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def bores():
    return [draw_bore(np.random.SeedSequence(7), 20.0, "paper", tolerances=on) for on in (False, True)]


def test_every_size_is_drawn_within_its_tolerance_and_differs_from_the_design() -> None:
    drawn = [draw_sizes(np.random.default_rng(seed)) for seed in range(40)]
    for size in fields(DESIGN):
        if size.name in TOLERANCE:
            values = np.array([getattr(one, size.name) for one in drawn])
            middle = 0.12 if size.name == "pocket_depth" else getattr(DESIGN, size.name)
            assert (abs(values - middle) <= TOLERANCE[size.name] + 1e-9).all(), size.name
            assert values.std() > 0.3 * TOLERANCE[size.name], size.name
    rows = np.array([one.row_depth for one in drawn])
    assert abs(rows[:, :4] - rows[:, 4:]).min(axis=1).max() > 0.0  # no bore is alike left and right


def test_without_tolerances_a_bore_is_as_designed_and_all_other_draws_stay(bores) -> None:
    designed, built = (bore.furniture for bore in bores)
    assert designed.sizes == DESIGN
    assert designed.rail_axis == pytest.approx(0.754)
    assert designed.joints[0] == built.joints[0]
    np.testing.assert_array_equal(designed.filled[:12], built.filled[:12])
    station = np.arange(0.0, 20.0)
    np.testing.assert_array_equal(bores[0].section.width(station), bores[1].section.width(station))


def test_a_rail_is_150_mm_wide_at_its_foot_16_at_its_web_and_73_at_its_head(bores) -> None:
    across, up = bores[0].furniture.rail_half.T
    width = 2e3 * np.interp([0.006, 0.045, 0.080, 0.115, 0.160], up, across)
    np.testing.assert_allclose(width, [150.0, 16.5, 16.5, 16.5, 73.0], rtol=1e-6)
