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
from scene.survey.bore import draw_bore
from scene.survey.cast import Hits, draw_returns, noise_sigma
from scene.survey.config import SensorErrors, SurveyConfig
from scene.survey.lidar import Lidar, avia, os1, vlp16
from scene.survey.mesh import Part
from scene.survey.section import draw_field


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


def hits(distance: float, cosine: float, n: int) -> Hits:
    full = [np.full(n, v, np.float32) for v in (distance, cosine)]
    return Hits(*full, np.full(n, Part.LINING, np.uint8), np.zeros((n, 3), np.float32))


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


@pytest.fixture(scope="module")
def bores():
    return [draw_bore(np.random.SeedSequence(7), 20.0, "paper", tolerances=on) for on in (False, True)]


def test_a_rail_is_150_mm_wide_at_its_foot_16_at_its_web_and_73_at_its_head(bores) -> None:
    across, up = bores[0].furniture.rail_half.T
    width = 2e3 * np.interp([0.006, 0.045, 0.080, 0.115, 0.160], up, across)
    np.testing.assert_allclose(width, [150.0, 16.5, 16.5, 16.5, 73.0], rtol=1e-6)
