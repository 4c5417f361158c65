"""A policy is a function: `action, memory = policy(obs, memory)`, whatever it is made of and wherever it is named."""

import dataclasses
import json
import shutil
import struct as binary
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines import registry
from subterra_jax.baselines.agent import Agent
from subterra_jax.baselines.registry import AgentError
from subterra_jax.episode import Driver
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.policies import PolicyError, files, load_policy, loading
from subterra_jax.policies.trained import Trained
from subterra_jax.recorder import RecorderConfig, record
from tests.subterra_jax.placing import PROBES

pytestmark = pytest.mark.door

TASK, DRIVEN = "Subterra/StopAtShort-v1", "Subterra/TraverseShort-v1"
SHORT = "TraverseShort-v1"
FEW = ("random", "fused")
LONG = tuple(pytest.param(name, marks=pytest.mark.slow) for name in ("oracle", "particle-filter"))
MINE = """
from flax import struct
import jax.numpy as jnp

@struct.dataclass
class Slow:
    speed: float = 0.7
    name: str = struct.field(pytree_node=False, default="slow")
    uses_lidar: bool = struct.field(pytree_node=False, default=False)
    uses_map: bool = struct.field(pytree_node=False, default=False)
    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, key, obs, params):
        return ()

    def act(self, key, memory, obs, params, known):
        return jnp.stack([self.speed, 0.0, jnp.nan, 0.0, 1.0]), memory
"""


@pytest.fixture(scope="module")
def world():
    return st.make(TASK, tunnel="subterra-351")


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A class in a file, a policy in a file, and a run folder with two checkpoints, the newer one of the policy."""
    (tmp_path / "mine.py").write_text(MINE)
    data = resources.files("subterra_jax") / "data" / "policies"
    for ending in (".safetensors", ".json"):
        with resources.as_file(data / f"{SHORT}{ending}") as packaged:
            shutil.copy(packaged, tmp_path / f"own{ending}")
            newer = tmp_path / "run" / "checkpoint" / "00000120"
            newer.mkdir(parents=True, exist_ok=True)
            shutil.copy(packaged, newer / f"policy{ending}")
    (tmp_path / "run" / "checkpoint" / "00000090").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    return tmp_path


def keep_all(now, taken, params):
    return {"action": taken.action, "obs": taken.observation, "state": taken.before}


@pytest.mark.parametrize("name", [*FEW, *LONG])
def test_the_function_drives_the_very_episode_that_the_evaluation_drives(name, world):
    env, params = world
    policy, driver = load_policy(name, env, params), Driver(env, keep=keep_all)
    first = driver.begin(params, policy.agent, 5)
    assert first.level == -1  # the episode draws its level itself
    _, kept = driver.go(params, policy.agent, first, 0, 12)
    memory = policy.initial_memory(first.agent_key)
    for k in range(12):
        state = jax.tree.map(lambda leaf, k=k: leaf[k], kept["state"]) if name == "oracle" else None
        action, memory = policy(kept["obs"][k], memory, state)
        np.testing.assert_allclose(action, kept["action"][k][:2], rtol=1e-5, atol=1e-6, err_msg=f"step {k}")


@pytest.mark.parametrize(("kind", "numpy_kind"), [("F16", "<f2"), ("F32", "<f4"), ("BF16", "<f2")])
def test_tensors_of_16_and_32_bits_are_read_as_32_and_no_others(kind, numpy_kind):
    values = np.array([[1.5, -0.1, 3e-5]], numpy_kind)
    header = json.dumps({"w": {"dtype": kind, "shape": [1, 3], "data_offsets": [0, values.nbytes]}}).encode()
    content = binary.pack("<Q", len(header)) + header + values.tobytes()
    if kind == "BF16":
        with pytest.raises(PolicyError, match=r"x: damaged policy: .*type BF16, not F32 or F16"):
            files.parse(content, "x")
        return
    read = files.parse(content, "x")["w"]
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values.astype(np.float32))


def test_a_batch_is_many_robots_and_each_has_a_key_of_its_own(world):
    env, params = world
    policy = load_policy("random", env, params)
    obs = jnp.ones((3, 21))
    memory = policy.initial_memory(jax.random.key(1), 3)
    actions, after = policy(obs, memory)
    for k, key in enumerate(jax.random.split(jax.random.key(1), 3)):
        alone, _ = policy(obs[k], policy.initial_memory(key))
        np.testing.assert_allclose(actions[k], alone, rtol=1e-6)
    assert len(np.unique(actions[:, 0])) == 3
    mapped, _ = jax.jit(jax.vmap(policy))(obs, memory)
    np.testing.assert_array_equal(mapped, actions)
    anew = policy.restart(after, jnp.array([False, True, False]))
    assert list(np.asarray(anew.steps)) == [1, 0, 1]
    again, _ = policy(obs, anew)
    assert not np.isclose(again[1, 0], actions[1, 0])  # another episode draws other numbers


BEGUN: list[int] = []


@struct.dataclass
class Drawn(Agent):
    """Drives at a speed drawn when its episode begins, a little faster each step, and notes how many it draws for."""

    name = "drawn"

    def begin(self, key, obs, params):
        speed = jax.random.uniform(key)
        return jax.pure_callback(lambda x: BEGUN.append(x.size) or x, speed, speed, vmap_method="expand_dims")

    def act(self, key, memory, obs, params, known):
        return jnp.stack([memory, 0.0, jnp.nan, 0.0, 1.0]), memory + 0.01


def test_a_batch_begins_the_memories_of_new_episodes_and_computes_few_others(world):
    env, params = world
    policy, n = load_policy(Drawn(), env, params), 64
    obs, memory = jnp.ones((n, 21)), policy.initial_memory(jax.random.key(1), n)
    _, memory = policy(obs, memory)
    each = jax.jit(jax.vmap(policy))
    for new, computed in (([], 0), ([5], 2), ([0, 63], 2), ([3, 4, 63], n)):
        done = jnp.zeros(n, bool).at[jnp.array(new, int)].set(True)
        before = policy.restart(memory, done)
        BEGUN.clear()
        action, memory = policy(obs, before)
        jax.block_until_ready(memory)
        assert sum(BEGUN) == computed
        alone, apart = each(obs, before)
        np.testing.assert_array_equal(action, alone)
        np.testing.assert_array_equal(memory.agent, apart.agent)
        kept = np.isin(np.arange(n), new, invert=True)
        np.testing.assert_allclose(memory.agent[kept] - before.agent[kept], 0.01, atol=1e-6)
        assert not np.isclose(memory.agent[~kept] - before.agent[~kept], 0.01, atol=1e-4).any()


def test_a_rollout_gives_a_policy_its_memory_and_begins_it_anew_with_each_episode():
    env, params = st.make(DRIVEN, horizon=7)
    policy, batch = load_policy(SHORT, env, params), st.AutoReset(env)
    obs, state = batch.reset(jax.random.key(0), params, 4)
    obs, state, steps = st.rollout(batch, policy, jax.random.key(1), obs, state, params, 10)
    assert np.asarray(steps["truncated"])[6].all()
    fresh = policy.initial_memory(n_envs=4)
    np.testing.assert_allclose(steps["action"][7], policy(steps["obs"][7], fresh)[0], rtol=1e-5, atol=1e-6)
    # In the middle of an episode the memory counts: earlier observations are in it.
    assert not np.allclose(steps["action"][6], policy(steps["obs"][6], fresh)[0], atol=1e-3)
    assert list(np.asarray(steps["memory"].steps)) == [3] * 4
    *_, more = st.rollout(batch, policy, jax.random.key(2), obs, state, params, 2, memory=steps["memory"])
    assert list(np.asarray(more["memory"].steps)) == [5] * 4


def test_a_policy_knows_its_own_task_and_a_gait_is_a_policy_too():
    policy = st.load_policy("TraverseShort-v1")
    assert policy.env.id == "Subterra/TraverseShort-v1"
    obs, _ = policy.env.reset(jax.random.key(0), policy.params)
    action, _ = policy(obs, policy.initial_memory())
    assert policy.env.action_space(policy.params).contains(action)
    gait = st.load_policy("B2Walk-v1")
    action, memory = gait(jnp.zeros((5, 56)), gait.initial_memory(n_envs=5))
    assert action.shape == (5, 12)
    assert gait.restart(memory, jnp.ones(5, bool)) == ()
    np.testing.assert_allclose(jax.jit(gait)(jnp.zeros((5, 56)), memory)[0], action, atol=1e-6)


@pytest.mark.parametrize("source", ["TraverseShort-v1", "dead-reckoning"])
def test_a_policy_itself_can_be_compiled(source):
    """It holds arrays and dicts of arrays, which have no hash; `jax.jit` asks for one."""
    policy = st.load_policy(source, *st.make(DRIVEN))
    obs, memory = jnp.ones(18), policy.initial_memory()
    (action, after), (same, alike) = policy(obs, memory), jax.jit(policy)(obs, memory)
    np.testing.assert_allclose(same, action, atol=1e-6)
    assert int(alike.steps) == int(after.steps) == 1


@pytest.mark.parametrize("source", ["policy:own.safetensors", "own.safetensors", "run", "policy:run", "run/checkpoint"])
def test_a_file_and_a_run_folder_are_policies_like_a_released_one(source, places):
    mine, released = load_policy(source), load_policy(SHORT)
    assert jax.tree.all(jax.tree.map(np.array_equal, mine.agent.tensors, released.agent.tensors))


DRIVERS = ("mine.py:Slow", "policy:own.safetensors", "policy:run")


def test_the_recorder_takes_a_class_of_other_people(places):
    trace = record(RecorderConfig(out=places / "out", task="TraverseShort", agent="mine.py:Slow", steps=3))
    np.testing.assert_allclose(trace.command[:, 0], 0.7)


@pytest.mark.slow
def test_board_and_recorder_drive_with_each_of_them(places):
    from benchmarks.board.__main__ import main as board

    words = ("--tasks", DRIVEN, "--episodes", "2", "--out", "board", "--agents", *DRIVERS)
    assert board([*words, "--splits", "--further", "subterra-351"]) == 0
    table = (places / "board" / "board.md").read_text()
    assert all(f"| {name} |" in table for name in DRIVERS)
    for k, name in enumerate(DRIVERS):
        trace = record(RecorderConfig(out=places / str(k), task="TraverseShort", agent=name, steps=3))
        assert (np.abs(trace.command[:, 0] - 0.7) < 1e-6).all() == (name == DRIVERS[0])


@pytest.mark.parametrize(
    ("source", "task", "error", "message"),
    [
        ("nobody", TASK, AgentError, r"no agent 'nobody'; there are random, .*; or policy:NAME"),
        ("policy:nobody", TASK, PolicyError, r"nobody: no such policy; released are"),
        ("empty", TASK, PolicyError, r"empty: holds no policy.safetensors; release it again"),
        ("nobody", None, AgentError, r"no agent 'nobody'; there are random, .*; or policy:NAME"),
        ("scan-matching", None, PolicyError, r"scan-matching: drives any task, so name one"),
        ("TraverseShort-v1", TASK, PolicyError, r"TraverseShort-v1: (has learnt|reads)"),
        ("B2Walk-v1", TASK, PolicyError, r"made for observations of 56 numbers, the B2 gives 21"),
        ("pathlib:Path", TASK, AgentError, r"agent 'pathlib:Path' has no uses_lidar"),
    ],
)
def test_what_cannot_drive_here_is_refused_in_one_sentence(source, task, error, message, tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message) as refused:
        load_policy(source, *(st.make(task, "subterra-351") if task else ()))
    assert "\n" not in str(refused.value)


def test_a_call_that_lacks_something_is_refused_in_one_sentence(world):
    env, params = world
    policy = load_policy("fused", env, params)
    with pytest.raises(PolicyError, match=r"fused: Subterra/StopAtShort-v1 has 21 numbers, got .* \(18,"):
        policy(jnp.zeros(18), policy.initial_memory())
    for wrong in (None, ()):
        with pytest.raises(PolicyError, match=r"fused: the first memory is policy.initial_memory\(\), got a"):
            policy(jnp.zeros(21), wrong)
    oracle = load_policy("oracle", env, params)
    with pytest.raises(PolicyError, match=r"oracle: is given the truth, so call it as policy\(obs, memory, state\)"):
        oracle(jnp.zeros(21), oracle.initial_memory())
    several = st.make(TASK, tunnel=["subterra-351", "control"], lining="smooth")
    policy = load_policy("fused", *several)
    with pytest.raises(PolicyError, match=r"drives in 2 tunnels, so call it as policy\(obs, memory, state\)"):
        policy(jnp.zeros(21), policy.initial_memory())
    with pytest.raises(PolicyError, match="belong together"):
        load_policy("fused", env)


@pytest.mark.parametrize("name", PROBES)
def test_the_function_gives_an_agent_what_it_declares_and_no_more(name):
    agent, speed = PROBES[name]
    env, params = st.make("Subterra/TraverseShort-v1")
    policy = load_policy(dataclasses.replace(agent), env, params)
    obs, state = env.reset(jax.random.key(0), params)
    action, _ = policy(obs, policy.initial_memory(), state)
    assert float(action[0]) == pytest.approx(speed)


def test_an_evaluation_takes_a_policy_as_it_takes_its_agent():
    env, params = st.make(DRIVEN, horizon=5)
    one = np.zeros(2, np.int32)
    episodes = Episodes(np.arange(2, dtype=np.uint32), one, one, one)
    policy = load_policy("random", env, params)
    by_function, by_agent = (evaluate(env, params, one, episodes) for one in (policy, policy.agent))
    assert by_function.travelled.min() > 0.0
    np.testing.assert_array_equal(by_function.travelled, by_agent.travelled)


@struct.dataclass
class Constant(Trained):
    """A kind of network of one tensor, its command."""

    kind = "constant"
    tensors: dict
    low: jnp.ndarray
    high: jnp.ndarray
    name: str = struct.field(pytree_node=False)
    conditions: policies.Conditions | None = struct.field(pytree_node=False)

    @classmethod
    def of_layout(cls, layout, **common):
        return cls(**common)

    def try_out(self):
        assert self.tensors["command"].shape == (2,)

    def check_task(self, env, params, source):
        if env.rule.goal_kind != "cover":
            raise PolicyError(f"{source}: only drives on")

    def begin(self, key, obs, params):
        return ()

    def act(self, key, memory, obs, params, known):
        return jnp.concatenate([self.tensors["command"], jnp.array([jnp.nan, 0.0, 0.0])]), memory


def test_a_new_kind_of_network_is_one_class_and_one_row(world, monkeypatch):
    monkeypatch.setitem(loading.KINDS, Constant.kind, Constant)
    layout = {"action_low": (0.0, -1.5), "action_high": (2.0, 1.5)}
    agent = policies.from_tensors("constant", layout, {"command": np.array([1.0, 0.25])}, "one")
    env, params = st.make(DRIVEN)
    assert agent.with_map(params) is agent
    policies.check_fits(agent, env, params, "one")
    policy = load_policy(agent, env, params)
    action, _ = policy(jnp.zeros(env.observation_size(params)), policy.initial_memory())
    np.testing.assert_allclose(action[:2], [1.0, 0.25])
    with pytest.raises(PolicyError, match="one: only drives on"):
        policies.check_fits(agent, *world, "one")
    with pytest.raises(ValueError, match="kind must be one of ppo, locate, constant, got 'lstm'"):
        policies.from_tensors("lstm", layout, {}, "one")
