"""PAR: the scene in MJX and the environment on its plan."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import planar
from benchmarks.fidelity.derive.contact import contact_depths
from tests.benchmarks.fidelity import tubescene
from tests.benchmarks.fidelity.judged import kept, measure
from tests.benchmarks.fidelity.tube import Tube, hold
from tests.recorded import check

SHORT = Tube(length=9.0, track=False, variation=0.0)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return Case(load_candidate(tubescene.write(tmp_path_factory.mktemp("scene") / "tube", SHORT)))


@pytest.fixture
def wider(good, tmp_path):
    """The good scene with the planar tunnel of a bore 20 cm wider."""
    other = tubescene.write(tmp_path / "other", replace(SHORT, width=SHORT.width + 0.2))
    return Case(replace(good.candidate, tunnel=other / "tunnel.npz"))


@pytest.mark.parametrize("id", [row.id for row in table.load().values() if row.category == "PAR" and row.scored])
def test_a_sound_scene_scores_full_marks(good, id):
    value = measure(id, good)
    assert table.load()[id].map.score(value.value) > 95.0, value


def test_the_robot_is_placed_on_both_sides_of_first_contact(good):
    ours, _ = contact_depths(good)
    assert 0.2 < np.mean(ours < 0.0) < 0.9


def test_an_environment_on_a_wider_tunnel_sees_it_wider(wider, good):
    assert measure("env_lidar_vs_mesh", wider).value > 0.09
    assert measure("mjx_ray_parity", wider).value > 0.09
    further = planar.observed_ranges(wider) - planar.observed_ranges(good)
    abreast = np.where(further > 1e-3, further, np.inf).min(axis=1)  # of the beam that meets a wall most squarely
    assert np.median(abreast) == pytest.approx(0.1, abs=0.02)


def test_noise_of_another_size_is_told(good, monkeypatch):
    monkeypatch.setattr(planar, "range_noise", lambda case: np.random.default_rng(0).normal(scale=0.08, size=100_000))
    assert measure("env_noise_sigma_err", good).value == pytest.approx(0.03, abs=1e-3)


def test_an_environment_that_does_not_repeat_fails(good, monkeypatch):
    drawn = np.random.default_rng(0)
    monkeypatch.setattr(planar, "_observe_episode", lambda case, actions: drawn.normal(size=(65, 18)))
    monkeypatch.setattr(planar, "repeated_observations", planar.repeated_observations.__wrapped__)
    assert measure("env_determinism", good).value == 0.0


def test_a_scene_that_mjx_refuses_fails(good, tmp_path):
    text = good.candidate.scene.read_text()
    path = good.candidate.folder / "ellipsoid.xml"
    shape = 'type="ellipsoid" size="0.3 0.2 0.3" mass="20" contype="3" conaffinity="3"'
    path.write_text(text.replace('type="sphere" size="0.3" mass="20" contype="0" conaffinity="3"', shape))
    value = measure("mjx_put_model", Case(replace(good.candidate, scene=path)))
    assert value.value == 0.0
    assert value.reason


def test_without_odometry_of_its_own_the_drift_has_nothing_to_be_compared_with(good):
    case = replace(good, hold=hold(SHORT))
    assert measure("env_odom_drift_ratio", case).value is None


def test_drift_is_compared_with_the_recordings_own_odometry(good, tmp_path):
    heard = hold(SHORT)
    first = np.flatnonzero(np.diff(heard.scan, prepend=-1))
    rows = np.zeros((len(first), 8))
    rows[:, 0], rows[:, 7] = heard.time[first], 1.0
    rows[:, 1:4] = heard.origin[first] * 1.02  # two metres in a hundred
    np.savetxt(tmp_path / "odometry.tum", rows)
    case = replace(good, hold=heard, candidate=replace(good.candidate, folder=tmp_path))
    assert measure("env_odom_drift_ratio", case).value == pytest.approx(0.0, abs=0.15)


def test_what_its_values_are_made_of_is_what_it_was(good):
    for id, row in table.load().items():
        if row.category == "PAR" and id not in ("mjx_put_model", "mjx_traj_divergence"):
            measure(id, good)
    planar.odometry_drift(good)
    derived = {name: value for name, value in kept(good).items() if "path_divergence" not in name}  # of rounding
    check(Path(__file__).with_name("values.csv"), "par", derived, 1e-3)
