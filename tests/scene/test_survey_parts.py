"""The parts of a simulated survey, one by one: pattern, errors, sizes within tolerance."""

import pickle
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from scene.survey import simulate
from scene.survey.alignment import draw_railway, lay_out
from scene.survey.cast import PULSE, Caster, Hits, Loaded, draw_returns, mix_pixels
from scene.survey.config import SensorErrors, SurveyConfig
from scene.survey.lidar import Lidar, avia, os1, vlp16
from scene.survey.mesh import Mesh, Part


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


class Sending(ExitStack):
    """A pool of processes that does nothing with what another process would have to read."""

    def __init__(self, *_: object) -> None:
        super().__init__()

    def submit(self, *job: object) -> Future[str]:
        sent: Future[str] = Future()
        sent.set_result(str(len(pickle.dumps(job))))
        return sent

    def shutdown(self, **_: object) -> None:
        pass


def test_a_further_lidar_of_a_long_survey_can_be_simulated_in_another_process(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(simulate, "_WORTH_A_PROCESS", 0.0)
    monkeypatch.setattr(simulate, "ProcessPoolExecutor", Sending)
    config = SurveyConfig(tmp_path, length=11.0, sensors=("vlp16", "os1"), scan_every=50)
    said = simulate.simulate(config, Console(quiet=True))
    assert int(said.split(", ")[-1]) > 100_000  # bytes
