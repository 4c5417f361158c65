"""What an agent is to the evaluation: how it remembers, what it sees, what it answers."""

import dataclasses
from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.env import TunnelEnv
from subterra_jax.state import EnvParams

Memory = Any
Known = dict[str, Float[Array, ""]] | None
Action = Float[Array, "5"]


@struct.dataclass
class Observed:
    """One observation, taken apart. A field that the task does not observe is None, which tells the tasks apart.

    Attributes:
        flat: The observation itself.
        ranges: LiDAR ranges, m, the first straight ahead, the others counter-clockwise.
        distance: Dead-reckoned distance, m.
        heading: Dead-reckoned heading, rad, in [-π, π]; 0 at the start.
        goal: Chainage of the goal, m.
        ring_pitch: Distance between rings of the lining, m; 0 where there are none.
        flag: 1 once the goal has been reached, else 0.
    """

    flat: Float[Array, "n_obs"]
    ranges: Float[Array, "n_beams"]
    distance: Float[Array, ""]
    heading: Float[Array, ""]
    goal: Float[Array, ""] | None = None
    ring_pitch: Float[Array, ""] | None = None
    flag: Float[Array, ""] | None = None


class Agent(Protocol):
    """An agent: a `flax.struct.dataclass` without state, whose leaves are numbers and arrays (gains, a map, weights).

    It is asked about one environment at a time, in pure JAX; the harness vmaps it. What it says it does not use it
    does not get: without `uses_lidar` the ranges are NaN, without `uses_map` everything in `params.tunnel` but its
    length and ring pitch is NaN, and only with `privileged` is `known` not None.
    """

    @property
    def name(self) -> str:
        """Name on the leaderboard."""

    @property
    def uses_lidar(self) -> bool:
        """Whether it reads the ranges."""

    @property
    def uses_map(self) -> bool:
        """Whether it reads the tunnel in `params`: the one it is in, where there are several."""

    @property
    def privileged(self) -> bool:
        """Whether it is told what `TunnelEnv.privileged` knows."""

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        """Memory at the start of an episode: any pytree of arrays.

        Args:
            key: Source of the agent's own randomness.
            obs: First observation.
            params: The task: sizes of noises, the believed start, tolerances.
        """

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """One control period.

        Args:
            key: Source of the agent's own randomness.
            memory: What it remembers. The first call gets the observation that `begin` got.
            obs: The observation.
            params: As for `begin`.
            known: The truth, or None.

        Returns:
            Always five numbers: speed (m/s), yaw rate (rad/s), station estimated for the end of this control period,
            which is when it is scored (m; NaN from one who has none), log of its standard deviation in m, and
            direction faced (that of growing station: above 0); and the memory.
        """


def observed(env: TunnelEnv, params: EnvParams, flat: Float[Array, "n_obs"], sees: bool = True) -> Observed:
    """An observation taken apart.

    Args:
        env: The environment that made it.
        params: The task.
        flat: The observation.
        sees: Whether the ranges are shown; NaN otherwise.
    """
    parts = env.fields(params)
    if not sees:
        flat = flat.at[parts["ranges"]].set(jnp.nan)
    further = {name: flat[parts[name]][0] for name in ("goal", "ring_pitch", "flag") if name in parts}
    distance, heading = flat[parts["odometry"]]
    return Observed(flat=flat, ranges=flat[parts["ranges"]], distance=distance, heading=heading, **further)


def shown(params: EnvParams, sees_map: bool) -> EnvParams:
    """The params as an agent gets them: without the map, every shape of the tunnel is NaN."""
    if sees_map:
        return params
    tunnel = params.tunnel
    hidden: dict[str, Any] = {name: jnp.full_like(getattr(tunnel, name), jnp.nan) for name in ("grid", "box", "wall")}
    return dataclasses.replace(params, tunnel=dataclasses.replace(tunnel, **hidden))
