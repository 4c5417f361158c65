"""The page about extensions: its files, from outside the package, work wherever a task or a sensor is taken."""

import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import tasks
from subterra_jax.baselines.registry import make_agent
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.host import task_ids
from subterra_jax.host.loading import load_file
from subterra_jax.parts import Part
from subterra_jax.rules import Start, StopAt, Traverse
from train.config import TrainConfig
from train.setup import make_learner
from train.world import open_world

pytestmark = pytest.mark.door

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "extend.md"
FILES = dict(re.findall(r"`(\w+\.py)`:?\s*\n\s*```python\n(.*?)```", PAGE.read_text(), re.DOTALL))
TASK = "keep_left.py:Mine/KeepLeft-v1"


def forget() -> None:
    """Lets the page's files run anew when they are asked for: a file runs once in a process."""
    for stem in (Path(name).stem for name in FILES):
        for loaded in [name for name in sys.modules if re.fullmatch(rf"{stem}(_[0-9a-f]{{12}})?", name)]:
            del sys.modules[loaded]


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder outside the package that holds the page's files; nothing that they register outlasts a test."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    forget()
    yield tmp_path
    forget()
    for added in set(tasks.TASKS) - set(task_ids.PLANAR):
        del tasks.TASKS[added]


def test_a_sensor_from_outside_is_observed_with_its_noise_and_its_bias(desk):
    gyro = load_file(desk / "gyro.py")
    env, params = st.make(
        "Subterra/StopAt-v1", parts=[gyro.Gyro()], gyro=gyro.GyroParams(sigma=0.02, bias_sigma=0.05), tunnel="control"
    )
    where = env.fields(params)["yaw_rate"]
    assert where.stop == env.observation_size(params)

    @jax.jit
    @jax.vmap
    def two_steps(key):
        keys = jax.random.split(key, 3)
        _, state = env.reset(keys[0], params)
        rates = []
        for k in keys[1:]:
            obs, state, *_ = env.step(k, state, jnp.array([0.0, 0.3]), params)
            rates.append(obs[where][0])
        return jnp.stack(rates)

    rates = np.asarray(two_steps(jax.random.split(jax.random.key(0), 2000)), float)
    assert rates.mean() == pytest.approx(0.3, abs=4 * 0.05 / np.sqrt(2000))
    # A bias is shared by the steps of an episode, noise is not.
    assert np.std(rates[:, 0] - rates[:, 1]) == pytest.approx(0.02 * np.sqrt(2), rel=0.1)
    assert np.std(rates.mean(axis=1)) == pytest.approx(np.hypot(0.05, 0.02 / np.sqrt(2)), rel=0.1)


def test_a_sensor_from_outside_leaves_the_other_entries_as_they_are(desk):
    gyro = load_file(desk / "gyro.py")
    plain, params = st.make("Subterra/Obstructed-v1")
    richer, more = st.make("Subterra/Obstructed-v1", parts=[gyro.Gyro()])
    _, one = plain.reset(jax.random.key(3), params)
    _, other = richer.reset(jax.random.key(3), more)
    np.testing.assert_array_equal(one.position, other.position)
    np.testing.assert_array_equal(one.goal.station, other.goal.station)
    assert list(richer.fields(more))[:-1] == list(plain.fields(params))


def test_its_params_are_randomised_like_those_of_the_package(desk):
    gyro = load_file(desk / "gyro.py")
    env, params = st.make("Subterra/Traverse-v1", parts=[gyro.Gyro()], tunnel="control")
    mixed, axes = st.randomize(jax.random.key(0), params, {"gyro.sigma": (0.1, 0.2)}, 8)
    batch = st.AutoReset(env, params_axes=axes)
    assert jax.eval_shape(lambda params: batch.reset(jax.random.key(1), params, 8), mixed)[0].shape == (8, 19)
    assert float(mixed.parts["gyro"].sigma.min()) >= 0.1


def test_a_task_from_outside_is_evaluated_on_listed_episodes(desk):
    env, params = st.make(TASK, tunnel="subterra-351")
    episodes = listed_episodes(env, params, 4)
    np.testing.assert_array_equal(episodes.seed, listed_episodes(env, params, 500).seed[:4])
    records = evaluate(env, params, make_agent("oracle", params), episodes)
    # Its controller keeps to the middle, 2.8 m from the wall, and drives on to the far mouth.
    assert not records.success.any()
    np.testing.assert_allclose(records.progress, 1.0)
    gap = load_file(desk / "keep_left.py").LaneParams(gap=2.8)
    wide, params = st.make(TASK, tunnel="subterra-351", lane=gap)
    assert evaluate(wide, params, make_agent("oracle", params), episodes).success.all()


def test_a_task_from_outside_works_with_gymnasium_and_stable_baselines(desk):
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("keep_left:Mine/KeepLeft-v1")
    assert env.reset(seed=0)[0]["gap"] == 2.0
    several = gymnasium.make_vec("Mine/KeepLeft-v1", num_envs=3)
    assert several.reset(seed=0)[0]["gap"].shape == (3, 1)
    pytest.importorskip("stable_baselines3")
    from subterra_jax.adapters.sb3 import SubterraVecEnv

    vector = SubterraVecEnv(2, TASK)
    vector.reset()
    assert vector.step(np.zeros((2, 2), np.float32))[1].shape == (2,)


HURRY = """
import dataclasses
import jax.numpy as jnp
import subterra_jax as st
from gyro import Gyro
from subterra_jax.rules import StopAt

@dataclasses.dataclass(frozen=True)
class Hurry(StopAt):
    key = "hurry"

    def judge(self, step, params):
        verdict = super().judge(step, params)
        return dataclasses.replace(verdict, terms={**verdict.terms, "reward_hurry": jnp.asarray(-0.05)})

st.register("Mine/Hurry-v1", Hurry(), horizon=300, parts=(*st.tasks.SLIPPING, Gyro()))
"""


def test_a_trainer_takes_a_task_reward_and_sensor_from_outside(desk):
    (desk / "hurry.py").write_text(HURRY)
    world = open_world("hurry.py:Mine/Hurry-v1", "control")
    learner = make_learner(world, TrainConfig(n_envs=4, unroll=8, minibatches=2, hidden=(8,)))
    assert learner.driver.layout.shape.n_inputs == 42
    state = jax.eval_shape(learner.init, jax.random.PRNGKey(0), world.params)
    assert "reward_hurry" in jax.eval_shape(learner.iterate, state, world.params)[1].metrics


class Twice(Part):
    """Observes what the odometer observes."""

    name = "twice"

    def observe(self, own, sensing, noise, params):
        return {"odometry": jnp.zeros(2)}

    def space(self, params):
        return {"odometry": (np.zeros(2), np.ones(2))}


class Needy(Traverse):
    """Wants slip."""

    needs = ("slip",)


class Crooked(Traverse):
    """Starts at two stations at once."""

    def start(self, draw, tunnel, params):
        return Start(jnp.zeros(2))


class Formless(Traverse):
    """Starts nowhere."""

    def start(self, draw, tunnel, params):
        return 0.0


@pytest.mark.parametrize(
    ("rule", "parts", "message"),
    [
        (Traverse(), (*tasks.PLAIN, Twice()), "the part 'odometry' and the part 'twice' observe 'odometry'"),
        (Traverse(), (*tasks.PLAIN, *tasks.PLAIN), "two parts are called"),
        (Needy(), tasks.PLAIN, "the rule Needy needs the part 'slip'; there are"),
        (Crooked(), tasks.PLAIN, r"the rule Crooked.start must return one number as station, got .*\(2,\)"),
        (Formless(), tasks.PLAIN, "the rule Formless.start must return a Start, got float"),
    ],
)
def test_parts_that_do_not_go_together_are_refused_in_one_sentence(rule, parts, message, monkeypatch):
    monkeypatch.setitem(tasks.TASKS, "Mine/Bad-v1", tasks.Task(rule, 10, (0.0, 60.0), parts))
    with pytest.raises(ValueError, match=message) as refused:
        st.make("Mine/Bad-v1")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("id", "rule", "message"),
    [
        ("Subterra/Traverse-v1", StopAt(), "is a task of the benchmark"),
        ("Mine/X-v1", StopAt(), "say horizon=STEPS, or like=ID"),
        ("Traverse", StopAt(), "must read Namespace/Name-v1"),
    ],
)
def test_a_registration_that_cannot_be_is_refused(id, rule, message):
    with pytest.raises(ValueError, match=message):
        st.register(id, rule, horizon=None if "horizon" in message else 10)


def test_spaces_have_samples_and_know_what_they_contain():
    env, params = st.make("Subterra/StopAt-v1", estimates=True)
    for space in (env.action_space(params), env.observation_space(params)):
        draws = jax.vmap(space.sample)(jax.random.split(jax.random.key(0), 64))
        assert draws.shape == (64, *space.shape)
        assert jax.vmap(space.contains)(draws).all()
    action = env.action_space(params)
    assert not action.contains(jnp.full(4, jnp.nan))
    assert not action.contains(jnp.zeros(3))
    assert not action.contains(action.high + 1.0)
