"""Dead reckoning: where along the tunnel one is, from commands, from odometry, from both, or from the truth."""

from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines import drift
from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.state import EnvParams

_LEAST = 0.01  # m; nobody knows better


@struct.dataclass
class Station:
    """An estimate.

    Attributes:
        station: Estimated station, m.
        log_sigma: Log of its standard deviation in m.
        direction: 1 where the robot faces growing stations, else -1.
    """

    station: Float[Array, ""]
    log_sigma: Float[Array, ""]
    direction: Float[Array, ""]


@struct.dataclass
class Driven:
    """What happened since the last estimate.

    Attributes:
        speed: Speed that was commanded, m/s; 0 before the first command.
        cosine: Of the angle between heading and axis, as the steering sees it.
        direction: 1 on the way out, -1 on the way back.
        flagged: The flag has just been raised: the goal is `flag_reach` away.
    """

    speed: Float[Array, ""]
    cosine: Float[Array, ""]
    direction: Float[Array, ""]
    flagged: Bool[Array, ""]


class Localiser(Protocol):
    """Keeps an estimate of the station; a `flax.struct.dataclass` without state."""

    privileged: bool

    def begin(self, obs: Observed, params: EnvParams) -> Any:
        """Its memory at the start."""

    def update(
        self, memory: Any, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Any]:
        """The estimate after a step, and the memory."""


@struct.dataclass
class Count:
    """Memory of one who counts.

    Attributes:
        station: Estimated station, m.
        start_sigma: Standard deviation of the station of the start, m.
        distance: Distance counted, m.
        steps: Steps driven.
        reading: Last reading of the odometer, m.
    """

    station: Float[Array, ""]
    start_sigma: Float[Array, ""]
    distance: Float[Array, ""]
    steps: Float[Array, ""]
    reading: Float[Array, ""]


def _counted(memory: Count, step: Float[Array, ""], driven: Driven, reading: Float[Array, ""]) -> Count:
    return Count(
        station=memory.station + driven.direction * driven.cosine * step,
        start_sigma=memory.start_sigma,
        distance=memory.distance + jnp.abs(step),
        steps=memory.steps + 1.0,
        reading=reading,
    )


def _start(obs: Observed, params: EnvParams) -> Count:
    zero = jnp.zeros(())
    return Count(*drift.believed_start(params), zero, zero, obs.distance)


def _station(memory: Count, sigma: Float[Array, ""], driven: Driven) -> Station:
    variance = jnp.maximum(sigma * sigma + memory.start_sigma * memory.start_sigma, _LEAST * _LEAST)
    return Station(memory.station, 0.5 * jnp.log(variance), driven.direction)


@struct.dataclass
class CommandCount:
    """Sums its own commands: where slip acted on the odometer alone, this would be a perfect one."""

    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, obs: Observed, params: EnvParams) -> Count:
        """At the believed start."""
        return _start(obs, params)

    def update(
        self, memory: Count, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Count]:
        """The sum so far."""
        del known
        memory = _counted(memory, driven.speed * params.vehicle.period, driven, obs.distance)
        return _station(memory, drift.command_sigma(memory.distance, params), driven), memory


@struct.dataclass
class OdometerCount:
    """Follows the odometer."""

    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, obs: Observed, params: EnvParams) -> Count:
        """At the believed start."""
        return _start(obs, params)

    def update(
        self, memory: Count, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Count]:
        """What it reads."""
        del known
        memory = _counted(memory, obs.distance - memory.reading, driven, obs.distance)
        return _station(memory, drift.odometry_sigma(memory.distance, memory.steps, params), driven), memory


@struct.dataclass
class Truth:
    """Is told the truth: the ceiling."""

    privileged: bool = struct.field(pytree_node=False, default=True)

    def begin(self, obs: Observed, params: EnvParams) -> Float[Array, ""]:
        """Nothing to remember."""
        del obs, params
        return jnp.zeros(())

    def update(
        self, memory: Float[Array, ""], obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Float[Array, ""]]:
        """The truth, claimed with the smallest standard deviation an action can hold."""
        del obs, driven, params
        assert known is not None
        direction = jnp.where(known["heading_cos"] > 0.0, 1.0, -1.0)
        return Station(known["station"], jnp.full((), -5.0), direction), memory
