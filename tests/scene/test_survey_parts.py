"""The parts of a simulated survey, one by one."""

from pathlib import Path

import numpy as np
import pytest

from scene.survey.__main__ import main
from scene.survey.alignment import draw_railway, lay_out
from scene.survey.lidar import AVIA_POINT_RATE, avia_directions, avia_point_times
from scene.survey.section import draw_field


@pytest.mark.parametrize(
    ("args", "reason"),
    [
        (["--length", "10"], "length must be more than 10 m"),
        (["--length", "nan"], "length must be more than 10 m"),
        (["--speed", "0"], "speed must lie between"),
        (["--point-rate", "100"], "point_rate must be a multiple of 60"),
        (["--seed", "-1"], "seed must not be negative"),
        (["--truth", "metro", "--length", "352"], "length must be at most 351 m for truth metro"),
        (["--truth", "irregular", "--correlation", "0.5"], "correlation must lie between 1 and 4 m"),
        (["--scan-every", "0"], "scan_every must be at least 1"),
        (["--sensors", "avia", "avia"], "sensors must differ"),
        (["--cloud", "--sensors"], "cloud needs a sensor"),
        (["--errors.lost", "1.5"], "errors.lost must lie between 0 and 1"),
        (["--errors.range-noise", "nan"], "errors.range_noise must not be negative"),
    ],
)
def test_a_wrong_value_is_refused_in_one_sentence(
    args: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--out", str(tmp_path / "out"), *args]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"error: {reason}")
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("")
    assert main(["--out", str(tmp_path / "out")]) == 2
    assert "out must be a folder" in capsys.readouterr().err


def rosette(begin: float, duration: float) -> np.ndarray:
    time = begin + np.arange(round(duration * AVIA_POINT_RATE)) / AVIA_POINT_RATE
    return avia_directions(time, np.array([0.3, 1.1]))


def angles(ray: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.stack([np.arctan2(ray[:, 1], ray[:, 0]), np.arcsin(ray[:, 2])], axis=-1))


def test_the_pattern_fills_its_field_of_view_and_no_more() -> None:
    ray = rosette(0.0, 2.0)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, atol=1e-12)
    across, upright = abs(angles(ray)).max(axis=0)
    assert 35.0 < across <= 35.2
    assert 38.4 < upright <= 38.6


def test_the_pattern_does_not_repeat() -> None:
    def pixels(ray: np.ndarray) -> np.ndarray:
        return np.unique(np.floor(angles(ray) / 0.2), axis=0)

    once, long = pixels(rosette(0.0, 0.1)), pixels(rosette(0.0, 2.0))
    assert len(long) > 3 * len(once)


def test_points_are_timed_within_their_message() -> None:
    offset = avia_point_times(240_000)
    assert (len(offset), offset[0], offset[-1]) == (24_000, 0, 99_995_833)
    assert (np.diff(offset) >= 0).all()


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


def test_a_field_has_the_spread_and_correlation_asked_for() -> None:
    rng = np.random.default_rng(1)
    at = np.array([0.0, 10.0])
    values = np.array([draw_field(rng, 0.05, 10.0).along(at) for _ in range(4000)])
    assert values.std() == pytest.approx(0.05, rel=0.03)
    assert np.corrcoef(values.T)[0, 1] == pytest.approx(np.exp(-1.0), abs=0.04)
