"""Episodes as the viewer drives them."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines.registry import make_agent
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.host.errors import SubterraError
from subterra_jax.policies.layout import Layout
from subterra_jax.policies.learnt import Learnt
from subterra_jax.policies.memories import Memory
from subterra_jax.policies.network import Shape
from subterra_jax.viewer import library
from subterra_jax.viewer.driving import drive
from tests.subterra_jax import tunnels

_NAMES = {"tunnel": "t", "tunnel_sha256": "0", "lining": "smooth", "agent": "dead-reckoning"}


@pytest.fixture(scope="module")
def task(plan_of):
    plan = plan_of(tunnels.tunnel_arrays(tunnels.straight(30.0)))
    return st.make("Subterra/Traverse-v1", tunnel=plan, lining="smooth")


@pytest.fixture(scope="module")
def parts(task):
    env, params = task
    return list(drive(env, params, make_agent("dead-reckoning", params), 5, _NAMES))


def test_an_episode_is_the_one_that_the_evaluation_drives(task, parts):
    env, params = task
    one = np.zeros(1, np.int32)
    record = evaluate(
        env, params, make_agent("dead-reckoning", params), Episodes(np.array([5], np.uint32), one, one, one)
    )
    whole = parts[-1]
    assert (whole.success, whole.contact) == (record.success[0], record.contact[0])
    np.testing.assert_allclose(whole.duration, record.time[0], atol=1e-3)
    np.testing.assert_allclose(whole.coverage[-1], record.coverage[0], atol=1e-5)
    travelled = np.linalg.norm(np.diff(whole.position, axis=0), axis=1).sum()
    np.testing.assert_allclose(travelled, record.travelled[0], rtol=1e-4)
    np.testing.assert_allclose(whole.estimate[-1, 0] - whole.station[-1], record.axial_final[0], atol=1e-3)


def test_an_episode_grows_from_its_start_and_keeps_what_it_had(parts):
    assert len(parts[0]) == 1
    assert len(parts) > 2
    for before, after in itertools.pairwise(parts):
        assert len(after) > len(before)
        np.testing.assert_array_equal(after.station[: len(before)], before.station)
    assert np.isnan(parts[-1].estimate[0]).all()
    assert np.isfinite(parts[-1].estimate[1:]).all()


def test_a_driver_that_does_not_fit_the_task_is_refused(plan_of, monkeypatch):
    plan = plan_of(tunnels.tunnel_arrays(tunnels.straight(30.0)))
    layout = Layout(Memory(), Shape(3, 2, (4,)), (0.0, -1.5), (2.0, 1.5))
    few = Learnt({}, jnp.zeros(2), jnp.array([2.0, 1.5]), layout, name="few")
    monkeypatch.setitem(library.registry._FACTORIES, "few", lambda params: few)
    with pytest.raises(SubterraError, match="few: reads 3 numbers; Subterra/Traverse-v1 with its fields"):
        next(library.drive_episode(plan, "0", "t", "smooth", "Subterra/Traverse-v1", "few", 0))


@pytest.mark.slow
def test_the_points_of_a_lidar_in_three_dimensions_are_recorded_and_shown():
    plan = st.load_tunnel("metro", solid=True)
    words = ("0", "t", "smooth", "Subterra/TraverseShort-v1", "dead-reckoning", 0, "spin16x64")
    first = next(library.drive_episode(plan, *words))
    assert first.points.shape == (1, 1024, 3)
    points = first.points[0][np.isfinite(first.points[0]).all(axis=1)]
    assert len(points) > 500
    assert np.ptp(points[:, 2]) > 1.0  # not a plane
    assert points[:, 2].min() > -0.5  # nothing far below the ground
    assert first.ranges.shape == (1, 16)
    from subterra_jax.viewer.geometry import Centreline, EpisodeGeometry

    np.testing.assert_allclose(EpisodeGeometry(first, Centreline(plan)).returns(0), points, atol=1e-6)


def test_baselines_and_released_policies_are_offered():
    assert {"particle-filter", "oracle", "policy:Traverse-v1", "policy:B2Traverse-v1"} <= set(library.driver_names())
