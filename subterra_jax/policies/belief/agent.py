"""A learnt histogram filter as an agent: put down anywhere in a tunnel whose map it has, it finds out where it is.

begin ─► drive along the axis ─► belief over every place and way to face ─► sure, or no further allowed ─► stop, report
              └──── a mouth ahead and not sure yet: turn round, and back the other way ────┘

Learnt is what a scan says of a place (`belief_scan`). The steering is the controller of the baselines.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.baselines.corridor import Corridor
from subterra_jax.baselines.rings import loop as rings
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.baselines.wallmap import WallMap, wall_map
from subterra_jax.policies.belief import grid
from subterra_jax.policies.belief import scan as belief_scan
from subterra_jax.policies.belief import turn as belief_turn
from subterra_jax.policies.belief.memory import Habits, Memory
from subterra_jax.policies.files import PolicyError
from subterra_jax.policies.layers import Tensors
from subterra_jax.state import EnvParams

KIND = "belief"
_MOUTH_BEAMS = (1, -1)  # the slanting beams ahead: without an echo on either side a mouth is some metres away
_BLOCK = 512  # cells of either tape weighed at once: more need more memory, not less time
_OUTSIDE = -3.0  # log likelihood, in a scan, of a place beyond a mouth
_CLUSTER = 0.8  # of the tolerance: half the length of what counts as one place
_LEAST_SIGMA = 0.01  # m


@struct.dataclass
class Belief:
    """Drives along the axis until it is sure of one place, or may go no further.

    Attributes:
        tensors: As `belief_scan.score`.
        low: Smallest action, m/s and rad/s.
        high: Largest action, m/s and rad/s.
        map: The map; None until it is `told`.
        n_cells: Cells of either tape; 0 until it is `told`.
        habits: How the belief is kept.
        name: Name on the leaderboard.
    """

    tensors: Tensors
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    map: WallMap | None = None
    n_cells: int = struct.field(pytree_node=False, default=0)
    habits: Habits = struct.field(pytree_node=False, default=Habits())
    name: str = struct.field(pytree_node=False, default="belief")
    uses_lidar: bool = struct.field(pytree_node=False, default=True)
    uses_map: bool = struct.field(pytree_node=False, default=True)
    privileged: bool = struct.field(pytree_node=False, default=False)

    def told(self, params: EnvParams) -> "Belief":
        """The same with the map of a task, whose tunnel may be a stack; on the host."""
        longest = float(np.max(np.asarray(params.tunnel.length)))
        n_cells = _BLOCK * int(np.ceil(longest / self.habits.cell / _BLOCK))
        return dataclasses.replace(self, map=wall_map(params.tunnel), n_cells=n_cells)

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        """Anywhere in the tunnel, facing either way.

        Raises:
            PolicyError: It has not been `told` the map.
        """
        del key
        if self.map is None:
            raise PolicyError(f"{self.name}: has no map yet; `told(params)` gives it that of a task")
        margin = jnp.asarray(params.goal.margin)
        zero = jnp.zeros(())
        return Memory(
            log_mass=grid.evenly(jnp.asarray(self._tape), jnp.asarray(params.tunnel.length), margin),
            track=rings.start((), obs.ranges.shape[0]),
            reading=obs.distance,
            walls=CentreLine().begin(obs, params),
            turn=belief_turn.straight(obs.heading),
            command=jnp.zeros(2),
            travelled=zero,
            sure=zero,
            stopped=jnp.zeros((), bool),
        )

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """One control period."""
        del key, known
        turn, done = belief_turn.watched(memory.turn, obs.heading)
        walls = CentreLine().look(memory.walls, obs, memory.command, params)
        walls = jax.tree.map(lambda new, old: jnp.where(done, new, old), CentreLine().turned(walls), walls)
        now = self._believed(dataclasses.replace(memory, walls=walls, turn=turn), obs, params, done)
        length, tolerance = jnp.asarray(params.tunnel.length), jnp.asarray(params.goal.tolerance)
        station = grid.stations(jnp.asarray(self._tape), now.track.station, length)
        told = grid.summary(now.log_mass, station, _CLUSTER * tolerance, self.habits.cell)
        now = self._decided(now, told, obs, params)
        command = CentreLine().steer(now.walls, jnp.asarray(params.vehicle.speed_max), params)
        command = jnp.where(belief_turn.turning(now.turn), belief_turn.command(now.turn, params), command)
        command = jnp.where(now.stopped, 0.0, jnp.clip(command, self.low, self.high))
        ahead = jnp.where(belief_turn.turning(now.turn), 0.0, command[0] * params.vehicle.period)
        log_sigma = jnp.log(jnp.maximum(told.sigma, _LEAST_SIGMA))
        report = jnp.stack([told.station + told.direction * ahead, log_sigma, told.direction])
        return jnp.concatenate([command, report]), dataclasses.replace(now, command=command)

    @property
    def _tape(self) -> Float[np.ndarray, "n_cells"]:
        return grid.position(self.n_cells, self.habits.cell)

    def _believed(self, memory: Memory, obs: Observed, params: EnvParams, done: Bool[Array, ""]) -> Memory:
        """The memory after what was driven and seen; `done` where it has just turned round."""
        habits, length = self.habits, jnp.asarray(params.tunnel.length)
        moved = rings.fuse_distances(memory.command[0] * params.vehicle.period, obs.distance - memory.reading)
        busy = belief_turn.turning(memory.turn) | done
        track = rings.advance(memory.track, obs.ranges, moved, jnp.ones(()), jnp.asarray(obs.ring_pitch))
        # What is driven while it turns leads nowhere in particular: a belief that spreads by as much.
        track = jax.tree.map(lambda old, new: jnp.where(busy, old, new), memory.track, track)
        variance = jnp.abs(moved) * (habits.lost_drift + track.strength * (habits.drift - habits.lost_drift))
        variance = jnp.where(busy, moved * moved, variance)
        log_mass = grid.spread(memory.log_mass, variance / habits.cell**2, habits.leak * jnp.abs(moved))
        turned = grid.turned_round(log_mass, track.station, length, habits.cell)
        log_mass = jnp.where(done, turned, log_mass)
        travelled = memory.travelled + jnp.where(done, track.station, 0.0) + jnp.where(busy, moved, 0.0)
        track = rings.restart(track, 1.0 - done)
        gain = jnp.where(busy, 0.0, self._gain(memory.walls, track.station, obs, params))
        return dataclasses.replace(
            memory, log_mass=grid.weighed(log_mass, gain), track=track, reading=obs.distance, travelled=travelled
        )

    def _gain(
        self, walls: Corridor, driven: Float[Array, ""], obs: Observed, params: EnvParams
    ) -> Float[Array, "2 n_cells"]:
        """Log likelihood of a scan in every cell."""
        assert self.map is not None
        here, length = self.map.pick(params.tunnel), jnp.asarray(params.tunnel.length)
        range_max = jnp.asarray(params.lidar.range_max)

        def block(tape: Float[Array, "n"]) -> Float[Array, "2 n"]:
            station = grid.stations(tape, driven, length)
            place = belief_scan.place_of(walls, station, jnp.broadcast_to(grid.FORWARD, station.shape))
            gain = belief_scan.score(self.tensors, here, place, obs.ranges, range_max)
            return jnp.where((station > 0.0) & (station < length), gain, _OUTSIDE)

        gain = jax.lax.map(block, jnp.asarray(self._tape).reshape(-1, _BLOCK))
        return gain.swapaxes(0, 1).reshape(2, -1)

    def _decided(self, now: Memory, told: grid.Summary, obs: Observed, params: EnvParams) -> Memory:
        """Whether to stop, or to turn round: at a mouth there is more to be seen the other way."""
        habits, busy = self.habits, belief_turn.turning(now.turn)
        sure = told.mass >= habits.sure_mass
        sure_for = jnp.where(sure, now.sure + now.command[0] * params.vehicle.period, 0.0)
        allowed = habits.furthest * params.goal.travel_max
        mouth = jnp.all(obs.ranges[jnp.asarray(_MOUTH_BEAMS)] >= params.lidar.range_max) & ~busy
        spent = now.travelled + now.track.station >= allowed
        stopped = now.stopped | (sure_for >= habits.sure_for) | spent
        turn = belief_turn.begun(now.turn, mouth & ~stopped)
        return dataclasses.replace(now, sure=sure_for, stopped=stopped, turn=turn)


def try_scan(tensors: Tensors) -> Float[Array, "2"]:
    """Two features' worth of the sensor, for shapes alone: a missing or misshapen tensor shows here."""
    return belief_scan.weight(tensors, jnp.zeros((2, belief_scan.N_FEATURES)), jnp.zeros(2))
