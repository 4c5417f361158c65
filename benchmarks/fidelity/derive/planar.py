"""The environment on the candidate's planar tunnel: beams, noise, repeated episodes, odometry."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import subterra_jax as st
from benchmarks.fidelity.case import Case, per_case
from benchmarks.fidelity.derive.scene import lidar_elevation, random_stations, scene_model, scene_ranges
from benchmarks.fidelity.derive.surface import surface_caster
from subterra_jax import lidar
from subterra_jax.parts import Noise, odometer
from subterra_jax.state import EnvParams, State

TASK = "Subterra/Traverse-v1"
PLAN_LINING = "pockets"
_POSE_COUNT = 400
_LATERAL = 0.8  # m to either side of the centreline
_NOISE_DRAWS = 100_000


@dataclass(frozen=True)
class LidarPoses:
    """Poses of the environment's LiDAR."""

    station: Float[np.ndarray, " k"]  # Station, m
    position: Float[np.ndarray, "k 3"]  # Position in the tunnel frame, m
    heading: Float[np.ndarray, " k"]  # Heading, rad
    way: Float[np.ndarray, "k b 3"]  # Directions of the beams in the plane that follows the grade, unit vectors

    def ranges_in_plan(self, reach: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, "k b"]:
        """Return the ranges along the beams in plan, at most `most`, m."""
        flat = np.linalg.norm(self.way[..., :2], axis=2)
        return np.minimum(reach.reshape(flat.shape) * flat, most)


def make_environment(case: Case) -> tuple[st.TunnelEnv, EnvParams]:
    return st.make(TASK, tunnel=case.candidate.tunnel, lining=PLAN_LINING)


@per_case
def lidar_poses(case: Case) -> LidarPoses:
    """Return random poses on both sides of the centreline, between ring stations, at random headings."""
    rng, params = case.rng("env_lidar_vs_mesh"), lidar.LidarParams()
    station, place, left = random_stations(case, "env_lidar_vs_mesh", _POSE_COUNT)
    lateral = rng.uniform(-_LATERAL, _LATERAL, _POSE_COUNT)
    place = place + lateral[:, None] * left
    place[:, 2] = lidar_elevation(case, station)
    heading = rng.uniform(-np.pi, np.pi, _POSE_COUNT)
    bearing = heading[:, None] + np.arange(params.n_beams) * (2.0 * np.pi / params.n_beams)
    grade = (lidar_elevation(case, station + 0.5) - lidar_elevation(case, station - 0.5)) / 1.0
    along = np.arctan2(-left[:, 0], left[:, 1])
    rise = grade[:, None] * np.cos(bearing - along[:, None])
    way = np.stack([np.cos(bearing), np.sin(bearing), rise], axis=2)
    return LidarPoses(station, place, heading, way / np.linalg.norm(way, axis=2, keepdims=True))


@per_case
def lidar_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """Return the noise-free beams of `subterra_jax.lidar` at the poses, m."""
    at, params = lidar_poses(case), lidar.LidarParams()
    tunnel = st.Tunnel.from_plan(st.load_tunnel(case.candidate.tunnel), PLAN_LINING, reach=params.range_max)
    scan = jax.jit(jax.vmap(lambda xy, heading, station: lidar.scan(tunnel, xy, heading, station, params)))
    return np.asarray(scan(*_plan_arrays(at)), float)


@per_case
def compile_observer(case: Case) -> Callable[[LidarPoses, jax.Array], np.ndarray]:
    """Return the function from poses and standard normal numbers to the ranges in the observations, m."""
    env, params = make_environment(case)

    def look(xy: jax.Array, heading: jax.Array, station: jax.Array, normal: jax.Array) -> jax.Array:
        fresh = env.begin(env.draw_reset(jax.random.key(0), (), params), params)
        state = fresh.replace(position=xy, heading=heading, station=station)
        return env.observe(state, {"lidar": Noise(normal)}, params)[: params.lidar.n_beams]

    compiled = jax.jit(jax.vmap(look))
    return lambda at, normal: np.asarray(compiled(*_plan_arrays(at), normal), float)


@per_case
def observed_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """Return the ranges in the environment's observations at the poses, noise set to 0, m."""
    at = lidar_poses(case)
    return compile_observer(case)(at, jnp.zeros(at.way.shape[:2]))


def _plan_arrays(at: LidarPoses) -> tuple[jax.Array, jax.Array, jax.Array]:
    return jnp.float32(at.position[:, :2]), jnp.float32(at.heading), jnp.float32(at.station)


@per_case
def mesh_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """Return the ranges of rays in the meshes at the poses, m."""
    at = lidar_poses(case)
    flat = at.way.reshape(-1, 3)
    reach = surface_caster(case).first(np.repeat(at.position, at.way.shape[1], axis=0), flat)[0]
    return at.ranges_in_plan(reach, float(lidar.LidarParams().range_max))


@per_case
def mujoco_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """Return the ranges by `mj_multiRay` in the compiled scene at the poses, m."""
    at = lidar_poses(case)
    reach = scene_ranges(scene_model(case), at.position, at.way)[0]
    return at.ranges_in_plan(reach, float(lidar.LidarParams().range_max))


@per_case
def range_noise(case: Case) -> Float[np.ndarray, " n"]:
    """Return noisy less noise-free ranges of the environment, of beams with a hit well within reach, m."""
    env, params = make_environment(case)
    at, clean = lidar_poses(case), observed_ranges(case)
    inside = (clean > 1.0) & (clean < float(params.lidar.range_max) - 1.0)
    if not inside.any():
        raise ValueError("no beam of the environment has a hit well within reach")
    differences: list[np.ndarray] = []
    for key in jax.random.split(jax.random.key(case.seed), -(-_NOISE_DRAWS // int(inside.sum()))):
        drawn = env.draw_step(key, (len(at.station),), params)["lidar"].normal
        differences.append((compile_observer(case)(at, drawn) - clean)[inside])
    return np.concatenate(differences)[:_NOISE_DRAWS]


# Episodes: their repetition, and the drift of the odometer.

_EPISODE_STEPS = 64
_ODOMETRY_LENGTH = 100.0  # m
_EPISODES = 256


@per_case
def repeated_observations(case: Case) -> Bool[np.ndarray, " k"]:
    """Return True for each observation that comes out the same in an environment made a second time."""
    actions = case.rng("env_determinism").uniform(-1.0, 2.0, (_EPISODE_STEPS, 2)).astype(np.float32)
    one, other = (_observe_episode(case, actions) for _ in range(2))
    return np.array([np.array_equal(a, b) for a, b in zip(one, other, strict=True)])


def _observe_episode(case: Case, actions: np.ndarray) -> np.ndarray:
    env, params = make_environment(case)
    return np.asarray(_roll_out(env, params, jax.random.key(case.seed), actions))


@partial(jax.jit, static_argnums=0)
def _roll_out(env: st.TunnelEnv, params: EnvParams, key: jax.Array, actions: jax.Array) -> jax.Array:
    begin, go = jax.random.split(key)
    first, state = env.reset(begin, params)

    def one(state: State, inputs: tuple[jax.Array, jax.Array]) -> tuple[State, jax.Array]:
        observation, state, *_ = env.step(inputs[0], state, inputs[1], params)
        return state, observation

    rest = jax.lax.scan(one, state, (jax.random.split(go, len(actions)), actions))[1]
    return jnp.concatenate([first[None], rest])


@per_case
def odometry_drift(case: Case) -> float:
    """Return the root mean square error of the odometer after 100 m at top speed, m."""
    env, params = make_environment(case)
    speed, period = float(params.vehicle.speed_max), float(params.vehicle.period)
    interval = jnp.asarray(params.vehicle.period)
    steps = int(_ODOMETRY_LENGTH / (speed * period))

    def episode(key: jax.Array) -> jax.Array:
        begin, go = jax.random.split(key)
        start = env.begin(env.draw_reset(begin, (), params), params).odometry
        drawn = env.draw_step(go, (steps,), params)["odometry"].normal
        motion = jnp.array([speed, 0.0])
        advance = partial(odometer.advance_odometry, backward=jnp.array(False))
        last = jax.lax.scan(lambda s, n: (advance(s, motion, interval, n, params.odometry), None), start, drawn)[0]
        return last.distance - steps * speed * period

    error = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(case.seed), _EPISODES))
    return float(np.sqrt(np.mean(np.asarray(error) ** 2)) * 100.0 / (steps * speed * period))
