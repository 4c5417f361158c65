"""Fixed episodes, and scores with known answers."""

import dataclasses
import hashlib
from importlib import resources
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import subterra_jax as st
from subterra_jax import episode
from subterra_jax.baselines import histogram
from subterra_jax.baselines.agent import Agent, Observed
from subterra_jax.baselines.cloud import CloudParams
from subterra_jax.baselines.histogram import HistogramLocaliser
from subterra_jax.baselines.registry import AgentError, make_agent, register
from subterra_jax.evaluation import Episodes, Records, evaluate, listed_episodes
from subterra_jax.evaluation import episodes as lists
from subterra_jax.evaluation.episodes import EvaluationError
from subterra_jax.evaluation.floor import floor, is_above
from subterra_jax.evaluation.records import (
    EstimateTally,
    Tally,
    add_estimate,
    add_step,
    area,
    crps,
    interval,
    make_records,
    start_estimates,
    start_tally,
    summarise,
)
from subterra_jax.rules import GoalParams
from tests.recorded import check
from tests.subterra_jax import tunnels


def test_the_list_is_the_one_whose_hash_is_known_and_holds_500_seeds_of_every_task():
    data = (resources.files("subterra_jax") / "data" / "evaluation.json").read_bytes()
    assert hashlib.sha256(data).hexdigest() == lists.SHA256
    seeds = np.stack([lists.listed_seeds(task) for task in st.TASKS])
    assert seeds.shape == (len(st.TASKS), 500)
    assert len(np.unique(seeds)) == seeds.size
    assert seeds.min() >= 2**30


def test_a_list_that_was_altered_is_refused(monkeypatch):
    monkeypatch.setattr(lists, "SHA256", "0" * 64)
    lists._listed.cache_clear()
    with pytest.raises(EvaluationError, match=r"evaluation\.json has SHA-256"):
        lists.listed_seeds("Subterra/StopAt-v1")
    lists._listed.cache_clear()


def test_episodes_are_spread_evenly_over_severities_and_tunnels():
    env, params = st.make("Subterra/Faulted-v1", tunnel="subterra-351")
    episodes = listed_episodes(env, params)
    assert np.bincount(episodes.severity).tolist() == [100] * 5
    assert np.bincount(episodes.group).tolist() == [50] * 10
    two = dataclasses.replace(params, tunnel=st.stack([params.tunnel] * 2))
    episodes = listed_episodes(env, two)
    assert (
        np.unique(np.stack([episodes.severity, episodes.tunnel]), axis=1, return_counts=True)[1].tolist() == [50] * 10
    )


def test_floors_are_what_they_were():
    told = {name: floor(st.make(f"Subterra/{name}-v1", "control")[1]) for name in ("StopAtShort", "Return", "Faulted")}
    check(__file__, "floors", told)


@pytest.mark.parametrize("n", [0, 501])
def test_a_number_of_episodes_that_the_list_has_not_is_refused(n):
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351")
    with pytest.raises(EvaluationError, match=f"episodes must be 1 to 500, got {n}"):
        listed_episodes(env, params, n)
    assert [len(listed_episodes(env, params, n).seed) for n in (1, 500)] == [1, 500]


@struct.dataclass
class Dawdler(Agent):
    """Drives straight on at a speed drawn at the start and stops for good at a station of its own estimate."""

    name = "dawdler"
    privileged = True
    stop: float = 1e6

    def begin(self, key, obs, params):
        return jnp.zeros(())

    def act(self, key, memory, obs, params, known):
        speed = jnp.where(known["station"] < self.stop, 2.0, 0.0)
        yaw_rate = -2.0 * known["heading_sin"] - 0.8 * known["lateral"]
        return jnp.stack([speed, yaw_rate, known["station"] + 1.0, jnp.zeros(()), jnp.ones(())]), memory + 1.0


def test_an_episode_depends_on_its_seed_and_its_tunnel_and_not_on_the_others_driven_with_it(plan_of):
    plans = [plan_of(tunnels.tunnel_arrays(pieces)) for pieces in (tunnels.straight(70.0), tunnels.arc(80.0, 60.0))]
    stacked = st.stack([st.Tunnel.from_plan(plan, "pockets") for plan in plans])
    near = GoalParams(low=10.0, high=50.0, margin=5.0)
    env, params = st.make("Subterra/StopAtShort-v1", tunnel=stacked, goal=near)
    agent, episodes = make_agent("dead-reckoning", params), listed_episodes(env, params, 5)
    together = evaluate(env, params, agent, episodes)
    apart = evaluate(env, params, agent, episodes, batch=3)
    for name, values in vars(together).items():
        np.testing.assert_array_equal(values, getattr(apart, name), err_msg=name)
    assert together.tunnel.tolist() == [0, 1, 0, 1, 0]
    assert len(np.unique(together.goal_error)) == 5
    # One tunnel turns left and the other does not: a wrong pick would hit a wall of the bend.
    assert not together.contact.any()
    assert (np.abs(together.goal_error) < 5.0).all()


def test_coverage_ends_at_nine_tenths_as_published_and_progress_goes_on_to_the_mouth():
    env, params = st.make("Subterra/TraverseShort-v1")
    episodes = listed_episodes(env, params, 3)
    through = evaluate(env, params, Dawdler(), episodes)
    assert through.success.all()
    assert ((through.coverage >= 0.9) & (through.coverage < 0.905)).all()
    assert (through.progress == 1.0).all()
    assert (through.time < 29.0).all()
    compiled = episode._go._cache_size()
    short = evaluate(env, params, Dawdler(stop=30.0), episodes)
    assert episode._go._cache_size() == compiled, "a second evaluation of a task compiles nothing"
    assert not short.success.any()
    np.testing.assert_allclose(short.progress, 0.5, atol=0.01)
    np.testing.assert_array_equal(short.progress, short.coverage)
    np.testing.assert_allclose(short.time, 60.0)
    # It says that it is a metre further than at the start of each period, and moves 0.2 m in one.
    np.testing.assert_allclose(through.axial_rms, 0.8, atol=0.02)
    check(__file__, "drives", {"through": through, "short": short, "summary": summarise(through)}, 5e-4)
    np.testing.assert_allclose(through.spl, 54.0 / through.travelled, rtol=1e-4)


def test_a_name_is_registered_once():
    with pytest.raises(AgentError, match="there is an agent 'oracle' already"):
        register("oracle", lambda params: Dawdler())
    with pytest.raises(AgentError, match="no agent 'nobody'"):
        make_agent("nobody", None)


def test_crps_of_a_normal_distribution_is_the_integral_that_defines_it():
    for error, sigma in ((0.0, 1.0), (0.7, 0.5), (-3.0, 2.0)):
        x = np.linspace(-60.0, 60.0, 600_001)
        from scipy.stats import norm

        squared = (norm.cdf(x, error, sigma) - (x >= 0.0)) ** 2
        np.testing.assert_allclose(crps(jnp.float32(error), jnp.float32(sigma)), np.trapezoid(squared, x), rtol=1e-3)


def test_an_episode_sums_its_offsets_and_keeps_its_least_clearance():
    env, params = st.make("Subterra/TraverseShort-v1", tunnel="control")
    _, state = env.reset(jax.random.key(0), params)
    tally = start_tally(env, state, params)
    for lateral, clearance in ((0.5, 0.4), (-1.0, 0.2), (0.5, 0.6)):
        info = {"lateral": lateral, "half_width": 2.0, "clearance": clearance, "coverage": 0.0, "success": False,
                "contact": False, "estimate_error": 0.0, "estimate_log_sigma": 0.0}  # fmt: skip
        taken = SimpleNamespace(before=state, after=state, action=jnp.zeros(4), info=jax.tree.map(jnp.asarray, info))
        tally = add_step(tally, taken, jnp.float32(1.0))
    assert float(tally.offset) == pytest.approx(1.0)
    assert float(tally.clearance) == pytest.approx(0.2)


@pytest.mark.parametrize(("errors", "above"), [(3.9, False), (4.1, True)])
def test_a_share_is_above_a_bound_by_four_standard_errors(errors, above):
    assert is_above(0.3 + errors * np.sqrt(0.3 * 0.7 / 400), 0.3, 400) == above


def tallied(errors, tolerance=1.0):
    tally = start_estimates()
    for step, error in enumerate(errors, 1):
        tally = add_estimate(tally, jnp.float32(error), jnp.zeros(()), jnp.int32(step), jnp.float32(tolerance))
    return tally


def test_time_to_lock_is_the_last_time_the_estimate_was_beyond_the_tolerance():
    assert tallied([0.5, 2.0, 0.5, 0.5]).unlocked == 2
    assert tallied([0.5, 0.5]).unlocked == 0


def test_the_bootstrap_interval_of_a_mean_is_that_of_the_normal_law():
    values = np.random.default_rng(1).standard_normal((10, 50))
    low, high = interval(values, lambda drawn: drawn.mean(axis=(-2, -1)))
    half = 1.96 * np.sqrt(values.var(axis=1).mean() / values.size)
    np.testing.assert_allclose([low, high], [values.mean() - half, values.mean() + half], atol=0.15 * half)
    assert interval(np.ones((10, 5)), lambda drawn: drawn.mean(axis=(-2, -1))) == (1.0, 1.0)


def test_the_area_under_faults_is_that_of_the_trapezia():
    assert area(np.arange(5.0), np.array([1.0, 1.0, 0.5, 0.0, 0.0])) == 0.5


def test_nothing_measured_is_no_number():
    n = 20
    columns = {field.name: np.full(n, np.nan) for field in dataclasses.fields(Records)}
    columns |= {name: np.zeros(n, int) for name in ("seed", "tunnel")}
    columns |= {"group": np.arange(n) // 2, "severity": np.arange(n) % 2, "travelled": np.full(n, 50.0)}
    columns |= {"success": np.arange(n) % 2 == 0, "contact": np.arange(n) < 5}
    records = Records(**columns)
    found = summarise(records)
    assert found["success"] == 0.5
    assert found["axial_rms"] is None
    assert found["contacts_per_100m"] == 0.5
    assert found["success_by_severity"] == {0: 1.0, 1: 0.0}
    assert found["success_area"] == 0.5


CELL, START = 0.1, 30.0


@pytest.fixture(scope="module")
def smooth(plan_of):
    """A straight tunnel without relief: the walls tell nothing of the station."""
    arrays = tunnels.tunnel_arrays(tunnels.straight(150.0), half_width=2.8)
    return st.make("Subterra/StopAt-v1", tunnel=plan_of(arrays), lining="smooth", estimates=True)


def localiser(params) -> HistogramLocaliser:
    return HistogramLocaliser.of(params, cell=CELL)


def seen(distance: float = 0.0, heading: float = 0.0) -> Observed:
    obs = Observed(jnp.zeros(18), jnp.full(16, 30.0), jnp.float32(distance), jnp.float32(heading))
    return dataclasses.replace(obs, start=jnp.float32(START))


def certain(filter_):
    """Return a filter whose heading does not wander and whose steps do not slip."""
    wander = dataclasses.replace(filter_.noise.wander, sigma=0.0)
    return dataclasses.replace(filter_, noise=CloudParams(0.015, wander, 0.0))


def test_a_row_of_errors_slides_by_its_share_of_the_way_and_back_again(smooth):
    _, params = smooth
    filter_ = localiser(params)
    still = certain(filter_)
    memory = jax.jit(still.begin)(seen(), params)
    mass = jnp.exp(memory.log_mass)
    slide = jax.jit(still._slide)
    tape = np.asarray(jax.jit(still._tape)(memory.origin))

    def middle(rows):
        weight = np.asarray(rows[0, -1], np.float64)
        return (weight * tape).sum() / weight.sum()

    before = middle(mass)
    for _ in range(50):
        mass = slide(mass, jnp.float32(0.2))
    assert middle(mass) - before == pytest.approx(histogram.MOST_SCALE * 10.0, abs=0.02)
    for _ in range(50):
        mass = slide(mass, jnp.float32(-0.2))
    assert middle(mass) - before == pytest.approx(0.0, abs=0.02)
    assert float(mass.sum()) == pytest.approx(1.0, abs=1e-3)


def test_the_middle_of_the_heaviest_cluster_is_told_not_the_highest_cell():
    mass = np.zeros((1, 100), np.float32)
    mass[0, 20:30], mass[0, 70] = 0.06, 0.4
    tell = jax.jit(histogram.summarise, static_argnums=3)
    station, _, way = tell(mass, np.arange(100.0, dtype=np.float32)[None], np.float32(10.0), 1.0)
    assert (float(station), way) == (pytest.approx(24.5), 1.0)


def test_figures_of_an_episode_follow_from_its_sums():
    """Two episodes of 10 and 20 steps of 0.1 s; the estimate of the second is off at the last step."""
    n = lambda *values: np.array(values)  # noqa: E731
    estimates = EstimateTally(n(0.5, -2.0), n(40.0, 80.0), n(5.0, 4.0), n(20.0, 10.0), n(9, 20))
    tally = Tally(
        steps=n(10, 20), travelled=n(8.0, 20.0), way=n(6.0, 25.0), offset=n(1.0, 5.0), lateral_square=n(2.5, 5.0),
        jerk=n(2.0, 3.0), clearance=n(0.3, 0.4), success=n(True, False), contact=n(False, True),
        goal_error=n(0.1, 9.0), coverage=n(0.5, 0.7), progress=n(0.6, 0.8), over=n(True, True), estimates=estimates,
    )  # fmt: skip
    episodes = Episodes(*(np.zeros(2, np.int32) for _ in range(4)))
    params = SimpleNamespace(vehicle=SimpleNamespace(period=0.1))
    found = make_records(tally, episodes, SimpleNamespace(rule=SimpleNamespace(goal_kind="stop")), params)
    expected = {
        "spl": (0.75, 0.0), "contacts_per_100m": (0.0, 5.0), "offset": (0.1, 0.25), "lateral": (0.5, 0.5),
        "time": (1.0, 2.0), "jerk": (0.2, 0.15), "axial_final": (0.5, -2.0), "axial_rms": (2.0, 2.0),
        "drift": (6.25, 10.0), "time_to_lock": (0.9, np.nan), "crps": (0.5, 0.2), "nees": (2.0, 0.5),
        "coverage": (np.nan, np.nan), "progress": (np.nan, np.nan),
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(found, name), values, err_msg=name)
    still = dataclasses.replace(tally, way=n(0.0, 0.0), travelled=n(0.0, 0.0))
    found = make_records(still, episodes, SimpleNamespace(rule=SimpleNamespace(goal_kind="stop")), params)
    assert np.isnan([found.spl, found.contacts_per_100m]).all()
