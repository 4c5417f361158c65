"""One driven episode, state by state: what the recorder writes, the viewer shows and a film draws."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Agent
from subterra_jax.baselines.cloud import Cloud
from subterra_jax.episode import Driver, Episode, Taken
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv

_CHUNK, _FEW = 100, 5  # steps between two tests for the end: of a robot on wheels, of one on legs
_PARTICLES = 96  # particles that are kept: enough to show the shape of a cloud
N_POSE = 19  # position, quaternion and joints of a robot on legs


@dataclasses.dataclass(frozen=True)
class Trace:
    """An episode of `n` steps, on the host; row k is the state after k periods, from 0 to n."""

    state: State  # states, each leaf with a leading axis of `n + 1`
    observation: Float[np.ndarray, "rows n_obs"]  # observations as the agent got them
    # action that led to row k + 1 as the agent gave it: speed (m/s), yaw rate (rad/s), estimated station (m; NaN for
    # none), log of its standard deviation, direction
    action: Float[np.ndarray, "n 5"]
    reward: Float[np.ndarray, "n"]  # reward of the step that led to row k + 1
    coverage: Float[np.ndarray, "n"]  # fraction of the tunnel covered by then
    # some of the agent's particles: station and lateral offset, m, and weight over the mean weight; `p` is 0 without a
    # particle filter
    cloud: Float[np.ndarray, "rows p 3"]
    # position (tunnel frame, m), orientation w, x, y, z and joints (rad) of a robot on legs at `m` even times up to a
    # row, the last at the row itself; `m` is 0 on wheels
    pose: Float[np.ndarray, "rows m 19"]
    period: float  # control period, s
    success: bool = False  # the task was achieved
    contact: bool = False  # the episode ended at a wall or an obstacle
    over: bool = False  # the episode ended, and was not cut after the steps that were asked for

    def __len__(self) -> int:
        return len(self.action)

    @property
    def ended(self) -> str:
        """Outcome of the episode in words: `success`, `contact`, `no success`, or `cut` by the steps asked for."""
        ended = "success" if self.success else "contact" if self.contact else "no success"
        return ended if self.over else "cut"

    @property
    def time(self) -> Float[np.ndarray, "rows"]:
        """Time of each row since the start, s."""
        return np.arange(len(self.observation)) * self.period

    @property
    def command(self) -> Float[np.ndarray, "n 2"]:
        """Speed (m/s) and yaw rate (rad/s) obeyed from row k to row k + 1."""
        return np.asarray(self.state.command)[1:]


def drive(
    env: TunnelEnv, params: EnvParams, agent: Agent, seed: int, severity: int | None = None, steps: int | None = None
) -> Trace:
    """Drive to the end of the episode, the one that `evaluation.evaluate` drives for the same seed and severity.

    Args:
        env: The environment; it need not have been made with `estimates`. Legs must be simulated by MuJoCo itself.
        params: The task in one tunnel.
        seed: Seed of everything random.
        severity: Severity of the faults; drawn where it is left out.
        steps: Steps at most; the task's horizon if left out.
    """
    env, legs = dataclasses.replace(env, estimates=True), _Legs(env)
    driver = Driver(env, keep=_keep)
    now = driver.begin(params, agent, seed, level=severity)
    state, obs, cloud = jax.device_get(_begun(driver, params, now))
    none, period = np.zeros(0, np.float32), round(float(params.vehicle.period), 6)  # 0.1 in float32 is not 0.1
    trace = Trace(state, obs, np.zeros((0, 5), np.float32), none, none, cloud, legs.standing(state, params), period)
    limit = int(params.horizon) if steps is None else min(steps, int(params.horizon))
    chunk = _CHUNK if legs.physics is None else _FEW
    try:
        for _, kept in driver.drive(params, agent, now, chunk, steps):
            rows: dict[str, Any]
            (after, noise), rows = jax.device_get(kept)
            over, left = rows.pop("over"), limit - len(trace)
            n = min(int(np.argmax(over)) + 1 if over.any() else chunk, left)
            end = jax.tree.map(lambda leaf, n=n: leaf[n - 1], (after, noise))
            ends: dict[str, Any] = {name: bool(rows.pop(name)[n - 1]) for name in ("success", "contact")}
            ends["over"] = bool(over[:n].any())
            rows["pose"] = legs.take(chunk)
            observed = [trace.observation[:-1], rows.pop("observation")[:n], _look(env, params, *end)[None]]
            series: dict[str, Any] = {
                name: np.concatenate([getattr(trace, name), values[:n]]) for name, values in rows.items()
            }
            state = jax.tree.map(lambda old, new, n=n: np.concatenate([old, new[:n]]), trace.state, after)
            trace = dataclasses.replace(trace, state=state, observation=np.concatenate(observed), **ends, **series)
    finally:
        legs.release()
    return trace


def _keep(now: Episode, taken: Taken, params: EnvParams) -> tuple[Any, dict[str, Any]]:
    """Keep one step: its end, and a row of each series."""
    return (taken.after, taken.noise), {
        "observation": taken.observation,
        "action": taken.action,
        "reward": taken.reward,
        "coverage": taken.info["coverage"],
        "cloud": _particles(taken.memory),
        "over": taken.terminated | taken.truncated,
        "success": taken.info["success"],
        "contact": taken.info["contact"],
    }


@functools.partial(jax.jit, static_argnums=0)
def _begun(driver: Driver, params: EnvParams, now: Episode) -> Any:
    first = now.state, driver.env.observe(now.state, now.noise, params), _particles(now.memory)
    return jax.tree.map(lambda leaf: leaf[None], first)


@functools.partial(jax.jit, static_argnums=0)
def _look(env: TunnelEnv, params: EnvParams, state: State, noise: Any) -> Float[Array, "n_obs"]:
    return env.observe(state, noise, params)


def _particles(memory: Any) -> Float[Array, "p 3"]:
    """Return about `_PARTICLES` of the particles in an agent's memory; none for an agent without."""
    clouds = [leaf for leaf in jax.tree.leaves(memory, is_leaf=_is_cloud) if _is_cloud(leaf)]
    if not clouds:
        return jnp.zeros((0, 3))
    cloud: Cloud = clouds[0]
    stride = max(1, cloud.log_weight.shape[0] // _PARTICLES)
    weight = jnp.exp(cloud.log_weight) * cloud.log_weight.shape[0]
    return jnp.stack([cloud.pose.station, cloud.pose.lateral, weight], axis=-1)[::stride][:_PARTICLES]


def _is_cloud(leaf: Any) -> bool:
    return isinstance(leaf, Cloud)


class _Legs:
    """Collects the poses of a walking robot as MuJoCo moves it; none of a wheeled one."""

    def __init__(self, env: TunnelEnv):
        walk: Any = getattr(env.motion, "walk", None)
        self.physics = None if walk is None else walk.physics
        self._poses: list[np.ndarray] = []
        if self.physics is not None:
            self.physics.bench.watch = lambda data: self._poses.append(data.qpos[:N_POSE].copy())

    def standing(self, state: State, params: EnvParams) -> Float[np.ndarray, "1 m 19"]:
        """Return the pose before the first step, as often as a step has control periods."""
        if self.physics is None:
            return np.zeros((1, 0, N_POSE))
        walk = state.legs
        pose = np.array(walk.body.qpos[0], np.float64)
        pose[:3] += np.asarray(params.walk.track.position[walk.anchor[0]], np.float64)
        return np.tile(pose, (1, round(float(params.vehicle.period) / self.physics.period), 1))

    def release(self) -> None:
        if self.physics is not None:
            self.physics.bench.watch = None

    def take(self, n_rows: int) -> Float[np.ndarray, "n_rows m 19"]:
        poses, self._poses = self._poses, []
        return np.array(poses).reshape(n_rows, -1, N_POSE) if poses else np.zeros((n_rows, 0, N_POSE))


def reckon(
    reading: Float[np.ndarray, "n 2"], position: Any = (0.0, 0.0), heading: float = 0.0
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Return positions (m) and headings (rad, unwrapped) by the odometer alone.

    Args:
        reading: Dead-reckoned distance (m) and heading since the start (rad); each step is taken along the mean of the
            headings before and after it.
        position: Position at the start, m.
        heading: Heading at the start, rad.
    """
    distance, turned = np.asarray(reading, np.float64).T
    turned = heading + np.unwrap(turned)
    middle, moved = 0.5 * (turned[1:] + turned[:-1]), np.diff(distance)
    steps = np.column_stack([moved * np.cos(middle), moved * np.sin(middle)])
    return np.asarray(position) + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), turned
