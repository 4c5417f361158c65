"""A learnt histogram filter as an agent: it starts anywhere in a mapped tunnel and finds out where it is.

start ─► drive along the axis ─► belief over station and direction ─► sure, or distance spent ─► stop and report
              └──── a mouth ahead and not yet sure: turn round and drive the other way ────┘

Learnt is how well a scan fits a place (`belief_scan`). The steering is the centre-line controller of the baselines.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.baselines.histogram import Summary
from subterra_jax.baselines.navigator import TURN_SPEED
from subterra_jax.baselines.rings import loop as rings
from subterra_jax.baselines.steering import CentreLine, Corridor
from subterra_jax.baselines.wallmap import WallMap, wall_map
from subterra_jax.parts.unicycle import wrap
from subterra_jax.policies import belief_grid, belief_scan
from subterra_jax.policies.files import Conditions, PolicyError
from subterra_jax.policies.trained import Tensors, Trained
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

KIND = "belief"
_MOUTH_BEAMS = (1, -1)  # the slanting beams ahead: without an echo on either side a mouth is some metres away
_BLOCK = 512  # cells of either tape that are scored at once: more need more memory, not less time
_OUTSIDE = -3.0  # log likelihood, in a scan, of a place beyond a mouth
_CLUSTER = 0.8  # of the tolerance: half the length of what counts as one place
_LEAST_SIGMA = 0.01  # m
_TURNED = 0.1  # rad; the steering corrects what is left of a turn


@dataclasses.dataclass(frozen=True)
class Habits:
    """Settings of the filter, and when the agent acts on its belief.

    Attributes:
        cell: Length of a cell, m.
        drift: Variance that each metre of dead reckoning adds while rings are counted, m.
        lost_drift: The same while no rings are seen.
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
class Turn:
    """A turn on the spot, measured by the odometer's heading.

    Attributes:
        left: Angle still to turn, rad; 0 while the robot drives.
        heading: Last reading of the odometer's heading, rad.
    """

    left: Float[Array, ""]
    heading: Float[Array, ""]

    @property
    def active(self) -> Bool[Array, ""]:
        """True while the robot turns round."""
        return self.left > 0.0

    def start(self, wanted: Bool[Array, ""]) -> "Turn":
        """Begins half a turn to the left where it is wanted and none is active."""
        return dataclasses.replace(self, left=jnp.where(wanted & ~self.active, jnp.pi, self.left))

    def update(self, heading: Float[Array, ""]) -> tuple["Turn", Bool[Array, ""]]:
        """Returns the turn after a reading of the heading (rad), and true where it has just ended."""
        left = self.left - wrap(heading - self.heading)
        ended = self.active & (left < _TURNED)
        return Turn(jnp.where(self.active & ~ended, left, 0.0), heading), ended

    def command(self, params: EnvParams) -> Float[Array, "2"]:
        """Returns speed (m/s) and yaw rate (rad/s). It creeps, because standing for a second ends the episode."""
        rate = jnp.minimum(jnp.asarray(params.vehicle.yaw_rate_max), self.left / params.vehicle.period)
        return jnp.stack([jnp.full_like(rate, TURN_SPEED), rate])


@struct.dataclass
class BeliefMemory:
    """Memory of the agent.

    Attributes:
        log_mass: Belief over where this drive began, see `belief_grid`.
        track: Distance of this drive, by dead reckoning and rings.
        reading: Last reading of the odometer's distance, m.
        walls: Tracked walls.
        turn: Turn on the spot.
        command: Last command, m/s and rad/s.
        travelled: Distance of earlier drives of the episode, m.
        sure: Distance over which it has been sure, m.
        stopped: True once it has stopped to report.
    """

    log_mass: Float[Array, "2 n_cells"]
    track: rings.RingTrack
    reading: Float[Array, ""]
    walls: Corridor
    turn: Turn
    command: Float[Array, "2"]
    travelled: Float[Array, ""]
    sure: Float[Array, ""]
    stopped: Bool[Array, ""]


@struct.dataclass
class Belief(Trained):
    """Drives along the axis until it is sure of one place, or may go no further.

    Attributes:
        tensors: As for `belief_scan.score`.
        low: Smallest action, m/s and rad/s.
        high: Largest action, m/s and rad/s.
        map: The map; None before `with_map`.
        n_cells: Cells of either tape; 0 before `with_map`.
        habits: Settings of the filter.
        name: Name on the leaderboard.
        conditions: Conditions of its training; None: any.
    """

    kind: ClassVar[str] = KIND
    uses_lidar = uses_map = True
    tensors: Tensors
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    map: WallMap | None = None
    n_cells: int = struct.field(pytree_node=False, default=0)
    habits: Habits = struct.field(pytree_node=False, default=Habits())
    name: str = struct.field(pytree_node=False, default="belief")
    conditions: Conditions | None = struct.field(pytree_node=False, default=None)

    @classmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "Belief":
        """Makes the agent of a layout with `habits`."""
        return cls(**common, habits=Habits(**layout["habits"]))

    def try_out(self) -> None:
        """Scores two beams, by shapes alone."""
        no_beams = jnp.zeros((2, belief_scan.N_FEATURES)), jnp.zeros(2)
        jax.eval_shape(belief_scan.beam_scores, self.tensors, *no_beams)

    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses a task that asks for no report."""
        del params
        if env.rule.errand != "report":
            raise PolicyError(f"{source}: a policy that finds out where it is, which {env.id} does not ask for")

    def with_map(self, params: EnvParams) -> "Belief":
        """Returns the agent with the map of a task, whose tunnel may be a stack; runs on the host."""
        longest = float(np.max(np.asarray(params.tunnel.length)))
        n_cells = _BLOCK * int(np.ceil(longest / self.habits.cell / _BLOCK))
        return dataclasses.replace(self, map=wall_map(params.tunnel), n_cells=n_cells)

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> BeliefMemory:
        """Returns the memory at the start: anywhere in the tunnel, in either direction.

        Raises:
            PolicyError: The agent has no map yet.
        """
        del key
        if self.map is None:
            raise PolicyError(f"{self.name}: has no map yet; `with_map(params)` gives it that of a task")
        margin = jnp.asarray(params.goal.margin)
        zero = jnp.zeros(())
        return BeliefMemory(
            log_mass=belief_grid.uniform_log_mass(jnp.asarray(self._tape), jnp.asarray(params.tunnel.length), margin),
            track=rings.start((), obs.ranges.shape[0]),
            reading=obs.distance,
            walls=CentreLine().begin(obs, params),
            turn=Turn(zero, obs.heading),
            command=jnp.zeros(2),
            travelled=zero,
            sure=zero,
            stopped=jnp.zeros((), bool),
        )

    def act(
        self, key: PRNGKeyArray, memory: BeliefMemory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, BeliefMemory]:
        """Returns command and report of one control period, and the memory after it."""
        del key, known
        turn, turned = memory.turn.update(obs.heading)
        walls = CentreLine().look(memory.walls, obs, memory.command, params)
        walls = jax.tree.map(lambda new, old: jnp.where(turned, new, old), CentreLine().turn_round(walls), walls)
        now = self._update(dataclasses.replace(memory, walls=walls, turn=turn), obs, params, turned)
        length, tolerance = jnp.asarray(params.tunnel.length), jnp.asarray(params.goal.tolerance)
        station = belief_grid.stations(jnp.asarray(self._tape), now.track.station, length)
        best = belief_grid.summarise(now.log_mass, station, _CLUSTER * tolerance, self.habits.cell)
        now = self._decide(now, best, obs, params)
        command = CentreLine().steer(now.walls, jnp.asarray(params.vehicle.speed_max), params)
        command = jnp.where(now.turn.active, now.turn.command(params), command)
        command = jnp.where(now.stopped, 0.0, jnp.clip(command, self.low, self.high))
        ahead = jnp.where(now.turn.active, 0.0, command[0] * params.vehicle.period)
        log_sigma = jnp.log(jnp.maximum(best.sigma, _LEAST_SIGMA))
        report = jnp.stack([best.station + best.direction * ahead, log_sigma, best.direction])
        return jnp.concatenate([command, report]), dataclasses.replace(now, command=command)

    @property
    def _tape(self) -> Float[np.ndarray, "n_cells"]:
        return belief_grid.cell_positions(self.n_cells, self.habits.cell)

    def _update(self, memory: BeliefMemory, obs: Observed, params: EnvParams, turned: Bool[Array, ""]) -> BeliefMemory:
        """Returns the memory after a motion and an observation; `turned` is true at the end of a turn."""
        habits, length = self.habits, jnp.asarray(params.tunnel.length)
        moved = rings.fuse_distances(memory.command[0] * params.vehicle.period, obs.distance - memory.reading)
        turning = memory.turn.active | turned
        track = rings.advance(memory.track, obs.ranges, moved, jnp.ones(()), jnp.asarray(obs.ring_pitch))
        # Motion during a turn has no known direction: it only spreads the belief.
        track = jax.tree.map(lambda old, new: jnp.where(turning, old, new), memory.track, track)
        variance = jnp.abs(moved) * (habits.lost_drift + track.strength * (habits.drift - habits.lost_drift))
        variance = jnp.where(turning, moved * moved, variance)
        log_mass = belief_grid.spread(memory.log_mass, variance / habits.cell**2, habits.leak * jnp.abs(moved))
        reversed_mass = belief_grid.turn_round(log_mass, track.station, length, habits.cell)
        log_mass = jnp.where(turned, reversed_mass, log_mass)
        travelled = memory.travelled + jnp.where(turned, track.station, 0.0) + jnp.where(turning, moved, 0.0)
        track = rings.restart(track, 1.0 - turned)
        gain = jnp.where(turning, 0.0, self._score_scan(memory.walls, track.station, obs, params))
        log_mass = belief_grid.add_evidence(log_mass, gain)
        return dataclasses.replace(memory, log_mass=log_mass, track=track, reading=obs.distance, travelled=travelled)

    def _score_scan(
        self, walls: Corridor, driven: Float[Array, ""], obs: Observed, params: EnvParams
    ) -> Float[Array, "2 n_cells"]:
        """Computes the log likelihood of a scan in every cell."""
        assert self.map is not None
        here, length = self.map.pick(params.tunnel), jnp.asarray(params.tunnel.length)
        range_max = jnp.asarray(params.lidar.range_max)

        def score_block(tape: Float[Array, "n"]) -> Float[Array, "2 n"]:
            station = belief_grid.stations(tape, driven, length)
            place = belief_scan.pose_at(walls, station, jnp.broadcast_to(belief_grid.FORWARD, station.shape))
            gain = belief_scan.score(self.tensors, here, place, obs.ranges, range_max)
            return jnp.where((station > 0.0) & (station < length), gain, _OUTSIDE)

        gain = jax.lax.map(score_block, jnp.asarray(self._tape).reshape(-1, _BLOCK))
        return gain.swapaxes(0, 1).reshape(2, -1)

    def _decide(self, now: BeliefMemory, best: Summary, obs: Observed, params: EnvParams) -> BeliefMemory:
        """Decides to stop, or to turn round: at a mouth more can be seen the other way."""
        habits, turning = self.habits, now.turn.active
        sure = best.mass >= habits.sure_mass
        sure_for = jnp.where(sure, now.sure + now.command[0] * params.vehicle.period, 0.0)
        allowed = habits.furthest * params.goal.travel_max
        mouth = jnp.all(obs.ranges[jnp.asarray(_MOUTH_BEAMS)] >= params.lidar.range_max) & ~turning
        spent = now.travelled + now.track.station >= allowed
        stopped = now.stopped | (sure_for >= habits.sure_for) | spent
        return dataclasses.replace(now, sure=sure_for, stopped=stopped, turn=now.turn.start(mouth & ~stopped))
