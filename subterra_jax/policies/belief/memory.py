"""What a belief's agent remembers, and the habits by which it keeps its belief."""

import dataclasses

from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.corridor import Corridor
from subterra_jax.baselines.rings import loop as rings
from subterra_jax.policies.belief import turn as belief_turn


@dataclasses.dataclass(frozen=True)
class Habits:
    """How the belief is kept and when it is acted upon.

    Attributes:
        cell: Length of a cell, m.
        drift: Variance that each metre of dead reckoning adds while rings are heard, m.
        lost_drift: The same while none are.
        leak: Share of the belief given to all cells alike in each metre.
        sure_mass: Share of the belief at one place from which on the robot is sure of it.
        sure_for: Distance over which it must be sure before it stops, m.
        furthest: Share of the distance that the task allows after which it stops in any case.
    """

    cell: float = 0.1
    drift: float = 5e-4
    lost_drift: float = 8e-3
    leak: float = 1e-6
    sure_mass: float = 0.999
    sure_for: float = 15.0
    furthest: float = 0.93


@struct.dataclass
class Memory:
    """What it remembers.

    Attributes:
        log_mass: Belief over where this drive began, see `belief_grid`.
        track: Distance of this drive, by dead reckoning and rings.
        reading: Last reading of the odometer's distance, m.
        walls: Tracked walls.
        turn: Turning round.
        command: Last command, m/s and rad/s.
        travelled: Driven in earlier drives of the episode, m.
        sure: Distance over which it has been sure, m.
        stopped: It has stopped to report.
    """

    log_mass: Float[Array, "2 n_cells"]
    track: rings.RingTrack
    reading: Float[Array, ""]
    walls: Corridor
    turn: belief_turn.Turn
    command: Float[Array, "2"]
    travelled: Float[Array, ""]
    sure: Float[Array, ""]
    stopped: Bool[Array, ""]
