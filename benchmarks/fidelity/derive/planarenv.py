"""The environment on the candidate's planar tunnel: its beams beside rays in scene and mesh, and its noise."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import subterra_jax as st
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import released, surface
from benchmarks.fidelity.derive.released import of_released
from benchmarks.fidelity.derive.scenerays import scene_ranges
from subterra_jax import lidar, odometry
from subterra_jax.state import EnvParams, State, StepNoise

TASK = "Subterra/Traverse-v0"
LINING = "pockets"
_POSES = 400
_LATERAL = 0.8  # m to either side of the centreline
_DRAWS = 100_000


@dataclass(frozen=True)
class Poses:
    """Places of the environment's LiDAR.

    Attributes:
        station: m, `(k,)`.
        position: Tunnel frame, m, `(k, 3)`.
        heading: rad, `(k,)`.
        way: Unit vectors of the beams in space, in the plane that follows the grade, `(k, b, 3)`.
    """

    station: Float[np.ndarray, " k"]
    position: Float[np.ndarray, "k 3"]
    heading: Float[np.ndarray, " k"]
    way: Float[np.ndarray, "k b 3"]

    def ranges_in_plan(self, reach: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, "k b"]:
        """Ranges along the beams as the plan sees them, at most `most`, m."""
        flat = np.linalg.norm(self.way[..., :2], axis=2)
        return np.minimum(reach.reshape(flat.shape) * flat, most)


def environment(case: Case) -> tuple[st.TunnelEnv, EnvParams]:
    """The task on the candidate's own tunnel, read afresh."""
    return st.make(TASK, tunnel=case.candidate.tunnel, lining=LINING)


@of_released("tunnel", "mesh")
def poses(case: Case) -> Poses:
    """Random poses on both sides of the centreline, between ring stations, at random headings."""
    rng, params = case.rng("env_lidar_vs_mesh"), lidar.LidarParams()
    station, place, left = released.along_axis(case, "env_lidar_vs_mesh", _POSES)
    lateral = rng.uniform(-_LATERAL, _LATERAL, _POSES)
    place = place + lateral[:, None] * left
    place[:, 2] = released.lidar_elevation(case, station)
    heading = rng.uniform(-np.pi, np.pi, _POSES)
    bearing = heading[:, None] + np.arange(params.n_beams) * (2.0 * np.pi / params.n_beams)
    grade = (released.lidar_elevation(case, station + 0.5) - released.lidar_elevation(case, station - 0.5)) / 1.0
    along = np.arctan2(-left[:, 0], left[:, 1])
    rise = grade[:, None] * np.cos(bearing - along[:, None])
    way = np.stack([np.cos(bearing), np.sin(bearing), rise], axis=2)
    return Poses(station, place, heading, way / np.linalg.norm(way, axis=2, keepdims=True))


@of_released("tunnel", "mesh")
def lidar_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """Noise-free beams of `subterra_jax.lidar` at the poses, m."""
    at, params = poses(case), lidar.LidarParams()
    tunnel = st.Tunnel.from_plan(st.load_tunnel(case.candidate.tunnel), LINING, reach=params.range_max)
    scan = jax.jit(jax.vmap(lambda xy, heading, station: lidar.scan(tunnel, xy, heading, station, params)))
    return np.asarray(scan(*_plan(at)), float)


@of_released("tunnel")
def viewer(case: Case) -> Callable[[Poses, jax.Array], np.ndarray]:
    """The ranges in the environment's observations at poses, given standard normal numbers for their noise, m."""
    env, params = environment(case)

    def look(xy: jax.Array, heading: jax.Array, station: jax.Array, normal: jax.Array) -> jax.Array:
        zero = jnp.zeros(2)
        odometer = odometry.start_odometry(zero, params.odometry)
        state = State(xy, heading, station, zero[0], station, zero, odometer, jnp.zeros((), jnp.int32))
        return env.observe(state, StepNoise(zero, normal), params)[: params.lidar.n_beams]

    compiled = jax.jit(jax.vmap(look))
    return lambda at, normal: np.asarray(compiled(*_plan(at), normal), float)


@of_released("tunnel", "mesh")
def observed_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """The ranges in the environment's observations at the poses, noise set to 0, m."""
    at = poses(case)
    return viewer(case)(at, jnp.zeros(at.way.shape[:2]))


def _plan(at: Poses) -> tuple[jax.Array, jax.Array, jax.Array]:
    return jnp.float32(at.position[:, :2]), jnp.float32(at.heading), jnp.float32(at.station)


@of_released("tunnel", "mesh")
def mesh_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """Rays in the meshes at the poses, m."""
    at = poses(case)
    flat = at.way.reshape(-1, 3)
    reach = surface.intersector(case).first(np.repeat(at.position, at.way.shape[1], axis=0), flat)[0]
    return at.ranges_in_plan(reach, float(lidar.LidarParams().range_max))


@of_released("scene", "tunnel", "mesh")
def mujoco_ranges(case: Case) -> Float[np.ndarray, "k b"]:
    """Rays by `mj_multiRay` in the compiled scene at the poses, m."""
    at = poses(case)
    reach = scene_ranges(released.model(case), at.position, at.way)[0]
    return at.ranges_in_plan(reach, float(lidar.LidarParams().range_max))


@of_released("tunnel", "mesh")
def noise(case: Case) -> Float[np.ndarray, " n"]:
    """Differences between noisy and noise-free ranges of the environment, beams with a hit well within reach, m."""
    env, params = environment(case)
    at, clean = poses(case), observed_ranges(case)
    inside = (clean > 1.0) & (clean < float(params.lidar.range_max) - 1.0)
    if not inside.any():
        raise ValueError("no beam of the environment has a hit well within reach")
    found: list[np.ndarray] = []
    for key in jax.random.split(jax.random.key(case.seed), -(-_DRAWS // int(inside.sum()))):
        drawn = env.draw_step(key, (len(at.station),), params).ranges
        found.append((viewer(case)(at, drawn) - clean)[inside])
    return np.concatenate(found)[:_DRAWS]
