"""Rules of version 1: starts and goals deep inside, the believed start observed, the nominal ring length told."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.parts.part import Bounds
from subterra_jax.rules.relocalise import Relocalise
from subterra_jax.rules.rule import Choice, Rule, Start, chosen, spread
from subterra_jax.rules.stop import GoalParams, GoalState, StopAt
from subterra_jax.rules.turn_back import ReturnState, TurnBack
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel


@struct.dataclass
class ToldParams:
    """Errors of what an agent is told.

    Attributes:
        pitch_error: Relative error of the ring length told against that of the tunnel's drawings, 1; for ablations.
    """

    pitch_error: float = 0.0


@struct.dataclass
class InsideState(GoalState):
    """Goal of one episode, and what is told.

    Attributes:
        told: Station of the start as it is told, m.
        pitch: Ring length as it is told, m; 0 where there are no rings.
    """

    told: Float[Array, ""]
    pitch: Float[Array, ""]


@struct.dataclass
class ReturnInsideState(ReturnState):
    """Goal of one episode, the way back from it, and what is told; the way back ends at the station told.

    Attributes:
        told: Station of the start as it is told, m.
        pitch: Ring length as it is told, m; 0 where there are no rings.
    """

    told: Float[Array, ""]
    pitch: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class StopInside(StopAt):
    """T1 of version 1: start further than `goal.margin` from both mouths, with a goal ahead.

    `goal.low` and `goal.high` are distances from the start. The believed start is observed as `start`; the true one is
    off by a normal number of `start.station_sigma`, cut off at three of them.
    """

    def defaults(self) -> dict[str, Any]:
        """Add `told` to the entries of `StopAt`."""
        return {**super().defaults(), "told": ToldParams()}

    def start(self, draw: tuple[Array, Array, Array], tunnel: Tunnel, params: EnvParams) -> Start:
        """Draw the distance, then the start in the room that is left, then how far the true start is off."""
        told, goal = draw_errand(draw[1], tunnel, params.goal)
        offset = params.start.station_sigma * jnp.clip(draw[2], -3.0, 3.0)
        pitch = tunnel.ring_pitch * (1.0 + params.told.pitch_error)
        own = InsideState(goal, jnp.zeros((), jnp.int32), told, pitch)
        return Start(told + offset, **spread(draw[0], params), own=own)

    def place(self, start: Start, choice: Choice) -> Start:
        """Return a start with a chosen place, which is told as it is, and goal; a drawn goal keeps its distance."""
        own = start.own
        told = chosen(choice.station, own.told)
        goal = chosen(choice.goal, own.station + told - own.told)
        start = Rule.place(self, start, choice)
        return dataclasses.replace(start, own=dataclasses.replace(own, station=goal, told=told))

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        """Add the believed start, m; the ring length is the nominal one."""
        return {**super().space(params), "start": (0.0, np.inf)}

    def observe(self, state: State, tunnel: Tunnel) -> dict[str, Array]:
        """Return the numbers that `space` names."""
        own = state.goal
        return {**super().observe(state, tunnel), "ring_pitch": own.pitch, "start": own.told}

    def least_length(self, params: EnvParams) -> float:
        """Return the nearest goal and a margin at either end, m."""
        return float(np.max(params.goal.low) + 2.0 * np.max(params.goal.margin))


@dataclasses.dataclass(frozen=True)
class TurnBackInside(StopInside, TurnBack):
    """T2 of version 1: success is a stop at the station told as the start, after the flag at the goal was raised."""

    def start(self, draw: tuple[Array, Array, Array], tunnel: Tunnel, params: EnvParams) -> Start:
        """Start as for `StopInside`, the flag down."""
        start = StopInside.start(self, draw, tunnel, params)
        own = start.own
        down = jnp.zeros_like(own.told)
        goal = ReturnInsideState(own.station, own.still, start=own.told, flag=down, told=own.told, pitch=own.pitch)
        return dataclasses.replace(start, own=goal)

    def place(self, start: Start, choice: Choice) -> Start:
        """Return a start with a chosen place, which is where the way back ends, and goal."""
        start = StopInside.place(self, start, choice)
        return dataclasses.replace(start, own=dataclasses.replace(start.own, start=start.own.told))


@dataclasses.dataclass(frozen=True)
class RelocaliseInside(Relocalise):
    """T5 of version 1: no mouth comes into sight within the travel that is allowed."""

    def least_length(self, params: EnvParams) -> float:
        """Return a metre and a margin at either end, m."""
        return float(1.0 + 2.0 * np.max(params.goal.margin))


def draw_errand(draw: Float[Array, "3"], tunnel: Tunnel, goal: GoalParams) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Draw the stations of start and goal, m, as far apart as the tunnel has room for.

    Args:
        draw: Uniform numbers in [0, 1): of the distance, and of the start.
        tunnel: The tunnel.
        goal: Bounds of the distance, and the least distance from a mouth.
    """
    room = jnp.maximum(tunnel.length - 2.0 * goal.margin, 0.0)
    high = jnp.minimum(goal.high, room)
    low = jnp.minimum(goal.low, high)
    distance = low + (high - low) * draw[0]
    start = goal.margin + (room - distance) * draw[1]
    return start, start + distance
