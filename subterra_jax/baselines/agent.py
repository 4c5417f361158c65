"""The contract of an agent: its memory, its inputs and its answer."""

import dataclasses
from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.lidar3d.beams import level_ring, level_row, n_level
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

Memory = Any
Known = dict[str, Float[Array, ""]] | None
Action = Float[Array, "5"]


@struct.dataclass
class Observed:
    """One observation, taken apart. An entry that the task does not observe is 0; `params.goal_kind` tells tasks apart.

    Attributes:
        flat: The observation itself.
        ranges: LiDAR ranges, m, the first straight ahead, the others counter-clockwise; of a LiDAR in three dimensions
            `beams.level_ring`.
        distance: Dead-reckoned distance, m.
        heading: Dead-reckoned heading, rad, in [-π, π]; 0 at the start.
        goal: Station of the goal, m.
        ring_pitch: Distance between rings of the lining, m; 0 where there are none.
        flag: 1 once the goal has been reached, else 0.
        start: Station of the start as reported, m; None where it is `params.start.station`.
        entries: Every entry of the observation by name, those of parts from outside included.
    """

    flat: Float[Array, "n_obs"]
    ranges: Float[Array, "n_beams"]
    distance: Float[Array, ""]
    heading: Float[Array, ""]
    goal: Float[Array, ""] | float = 0.0
    ring_pitch: Float[Array, ""] | float = 0.0
    flag: Float[Array, ""] | float = 0.0
    start: Float[Array, ""] | None = None
    entries: dict[str, Array] = struct.field(default_factory=dict)


class Agent(Protocol):
    """An agent: a `flax.struct.dataclass` without state, whose leaves are numbers and arrays (gains, a map, weights).

    It is asked about one environment at a time, in pure JAX; whoever drives it vmaps it. An agent receives only the
    inputs that it declares: without `uses_lidar` the ranges are NaN, without `uses_map` everything in `params.tunnel`
    but its length and ring pitch is NaN, and only with `privileged` is `known` not None. A class that inherits declares
    by a line in its body, `uses_lidar = True`; any other class may be an agent if it has these four and both methods.

    Attributes:
        name: Name on the board.
    """

    name: str

    @property
    def uses_lidar(self) -> bool:
        """True where it reads the ranges."""
        return False

    @property
    def uses_map(self) -> bool:
        """True where it reads the tunnel in `params`: the one it is in, of a stack."""
        return False

    @property
    def privileged(self) -> bool:
        """True where it gets the truth of `TunnelEnv.privileged`."""
        return False

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        """Returns the memory at the start of an episode: any pytree of arrays.

        Args:
            params: The task: sizes of noises, the believed start, tolerances.
        """

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """Returns the action of one control period, and the memory after it.

        Args:
            memory: Memory so far. The first call gets the observation that `begin` got.
            params: As for `begin`.
            known: The truth; None for an agent that is not `privileged`.

        Returns:
            Always five numbers: speed (m/s), yaw rate (rad/s), station estimated for the end of this control period,
            which is when it is scored (m; NaN for none), log of its standard deviation in m, and
            direction faced (that of growing station: above 0); and the memory.
        """


LIDAR_ENTRIES = frozenset({"ranges", "scan", "intensity", "doppler"})


def n_ranges(params: EnvParams) -> int:
    """Return the number of `Observed.ranges`."""
    sensor = params.lidar
    return n_level(sensor.shape) if hasattr(sensor, "shape") else sensor.n_beams


def level_ranges(obs: Observed, params: EnvParams) -> Float[Array, "n"]:
    """Return all level beams that there are, m: `Observed.ranges`, or the whole ring of a LiDAR in three dimensions."""
    return level_row(obs.entries["scan"], params.lidar.shape) if "scan" in obs.entries else obs.ranges


def level_intensity(obs: Observed, params: EnvParams, whole: bool = False) -> Float[Array, "n"] | None:
    """Return the intensities of `Observed.ranges`, or `whole` of `level_ranges`; `None` without the channel."""
    if "intensity" not in obs.entries:
        return None
    shape, seen = getattr(params.lidar, "shape", None), obs.entries["intensity"]
    return seen if shape is None else (level_row if whole else level_ring)(seen, shape)


def range_sigma(params: EnvParams) -> float:
    """Return the standard deviation of a range met near and squarely, m, of either kind of LiDAR; on the host."""
    sensor = params.lidar
    return float(sensor.echo.sigma if hasattr(sensor, "echo") else sensor.range_sigma)


def observed(env: TunnelEnv, params: EnvParams, flat: Float[Array, "n_obs"], sees: bool = True) -> Observed:
    """Take an observation apart.

    Args:
        env: The environment that made it.
        sees: Show the ranges; NaN otherwise.
    """
    fields = env.fields(params)
    if not sees:
        for name in LIDAR_ENTRIES & set(fields):
            flat = flat.at[fields[name]].set(jnp.nan)
    entries = {name: flat[where] for name, where in fields.items()}
    ranges = entries["ranges"] if "ranges" in entries else level_ring(entries["scan"], params.lidar.shape)
    distance, heading = entries["odometry"]
    further = {name: entries[name][0] for name in ("goal", "ring_pitch", "flag", "start") if name in entries}
    return Observed(flat, ranges, distance, heading, **further, entries=entries)


def shown(params: EnvParams, sees_map: bool) -> EnvParams:
    """Return the params as an agent gets them: without the map, every shape of the tunnel is NaN."""
    if sees_map:
        return params
    tunnel = params.tunnel
    tunnel = dataclasses.replace(tunnel, space=None)
    hidden: dict[str, Any] = {name: jnp.full_like(getattr(tunnel, name), jnp.nan) for name in ("grid", "box", "wall")}
    return params.replace(tunnel=dataclasses.replace(tunnel, **hidden))
