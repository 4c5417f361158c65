"""Memories of a policy beside the network's own: reckoning, a stack, a localiser.

The station that the inputs show as a way to go is dead-reckoned; with `along` it is the learnt localiser's, with `map`
that of a histogram filter on the map. All functions take one robot; training and driving call the same ones.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.histogram import HistogramLocaliser
from subterra_jax.baselines.stations import Driven, Station, believed_start, odometry_sigma, reported_start
from subterra_jax.baselines.steering import CentreLine, Corridor
from subterra_jax.policies import inputs
from subterra_jax.policies.inputs import Reckoned
from subterra_jax.policies.locate.locator import Locator
from subterra_jax.policies.locate.map_strip import MapStrip
from subterra_jax.policies.locate.ways import TwoWays
from subterra_jax.state import EnvParams

_SURE = 3.0  # standard deviations of the odometer
MEMORIES = ("none", "stack", "gru", "along", "map")


@struct.dataclass
class Located:
    """A localiser under way."""

    walls: Corridor  # walls beside the robot, as tracked
    direction: Float[Array, ""]  # 1 on the way out, -1 on the way back
    localiser: Any  # its memory
    station: Station  # its estimate


@struct.dataclass
class Kept:
    """The memory between two observations."""

    reckoned: Reckoned  # dead reckoning
    stack: Float[Array, "earlier n"]  # inputs of earlier observations, oldest first; none without a stack
    located: Located | None  # the localiser; None without one
    seen: Float[Array, "n"]  # inputs of the newest observation


@dataclasses.dataclass(frozen=True)
class Memory:
    """A choice of memory."""

    kind: str = "none"  # one of `MEMORIES`
    frames: int = 1  # observations in the stack, the newest included; 1 but with `stack`, `along`
    cell: float = 0.1  # length of a cell of the belief, m; for `map`
    walls: bool = False  # show the walls as they are tracked from scan to scan too; where a localiser does so

    @property
    def locates(self) -> bool:
        """True where a localiser estimates the station; the inputs then end with how sure it is."""
        return self.kind in ("along", "map")

    @property
    def relief(self) -> bool:
        """True where the inputs show the relief of the walls: who forgets it has no use for it."""
        return self.kind == "gru" or self.frames > 1

    def begin(self, obs: Observed, params: EnvParams, given: "Given") -> Kept:
        """Returns what is kept before the first `take`, which gets the same observation and a command of 0."""
        reckoned = inputs.begin(obs)
        located = None
        if self.locates:
            localiser, anywhere = given.localiser(params), params.goal_kind == "report"
            start, sigma = believed_start(obs, params) if anywhere else (reported_start(obs, params), 0.05)
            station = Station(jnp.asarray(start, jnp.float32), jnp.log(jnp.float32(sigma)), jnp.ones(()))
            located = Located(CentreLine().begin(obs, params), jnp.ones(()), localiser.begin(obs, params), station)
        seen = self._look(reckoned, located, obs, params)
        return Kept(reckoned, jnp.repeat(seen[None], self.frames - 1, axis=0), located, seen)

    def take(self, before: Kept, command: Float[Array, "2"], obs: Observed, params: EnvParams, given: "Given") -> Kept:
        """Returns what is kept after a command (m/s and rad/s, as obeyed) and the observation that followed."""
        reckoned = inputs.see(inputs.obey(before.reckoned, command, params.vehicle.period), obs)
        located = before.located
        if located is not None:
            raised = reckoned.flag > before.reckoned.flag
            located = self._locate(located, reckoned, raised, command, obs, params, given)
        seen = self._look(reckoned, located, obs, params)
        stack = jnp.concatenate([before.stack[1:], before.seen[None]])[: self.frames - 1]
        return Kept(reckoned, stack, located, seen)

    def inputs(self, kept: Kept) -> Float[Array, "n"]:
        """Returns the inputs of the network, the oldest observation first."""
        return jnp.concatenate([kept.stack.reshape(-1), kept.seen])

    def far_from_goal(self, reckoned: Reckoned, walls: Corridor, obs: Observed, params: EnvParams) -> Float[Array, "n"]:
        """Returns the inputs of a robot whose goal is far away, for `along`."""
        seen = inputs.look(reckoned, obs, jnp.float32(inputs.FAR), params, self.relief)
        return self._with_place(seen, jnp.zeros(()), walls)

    def report(
        self, kept: Kept, command: Float[Array, "2"], obs: Observed | None, params: EnvParams
    ) -> Float[Array, "3"]:
        """Returns station (m), log of its standard deviation (m) and direction at the end of a command.

        The observation that it answers is not needed where a localiser estimates the station.
        """
        station, log_sigma, direction = self._estimate(kept, obs, params)
        return jnp.stack([station + direction * command[0] * params.vehicle.period, log_sigma, direction])

    def _estimate(self, kept: Kept, obs: Observed | None, params: EnvParams) -> tuple[Array, Array, Array]:
        """Returns station and log of its standard deviation before the command, and the direction."""
        if kept.located is not None or obs is None:
            assert kept.located is not None, "dead reckoning needs the observation"
            station = kept.located.station
            return station.station, station.log_sigma, station.direction
        way = inputs.way_to_go(kept.reckoned, obs, params)
        target = obs.goal if params.goal_kind in ("stop", "return") else params.tunnel.length
        out = target - way
        if params.goal_kind == "return":
            out = jnp.where(kept.reckoned.flag > 0.5, reported_start(obs, params) + way, out)
        return out, jnp.log(jnp.float32(1.0)), jnp.where(kept.reckoned.turned, -1.0, 1.0)

    def _look(self, reckoned: Reckoned, located: Located | None, obs: Observed, params: EnvParams) -> Array:
        way = inputs.way_to_go(reckoned, obs, params)
        log_sigma = jnp.zeros(())
        if located is not None and params.goal_kind == "report":
            # As far as it surely may: who drives on for longer than allowed has failed.
            doubt = _SURE * odometry_sigma(params.goal.travel_max, jnp.zeros(()), params)
            way = params.goal.travel_max - doubt - (obs.distance - reckoned.distance)
            log_sigma = located.station.log_sigma
        elif located is not None:
            station, log_sigma = located.station.station, located.station.log_sigma
            way = obs.goal - station
            if params.goal_kind == "return":
                way = jnp.where(reckoned.flag > 0.5, station - reported_start(obs, params), way)
        seen = inputs.look(reckoned, obs, way, params, self.relief)
        return seen if located is None else self._with_place(seen, log_sigma, located.walls)

    def _with_place(self, seen: Array, log_sigma: Array, walls: Corridor) -> Array:
        """Returns inputs with what the localiser adds to them."""
        further = inputs.beside(walls) if self.walls else jnp.zeros(0)
        return jnp.concatenate([seen, log_sigma[None], further])

    def _locate(
        self,
        before: Located,
        reckoned: Reckoned,
        raised: Array,
        command: Array,
        obs: Observed,
        params: EnvParams,
        given: "Given",
    ) -> Located:
        """Moves the walls and the localiser on by one command and the observation after it."""
        walls = CentreLine().look(before.walls, obs, command, params)
        direction = jnp.where(reckoned.turned, -1.0, 1.0)
        mirrored, turned = CentreLine().turn_round(walls), direction != before.direction
        walls = jax.tree.map(lambda new, old: jnp.where(turned, new, old), mirrored, walls)
        driven = Driven(command[0], CentreLine().cosine(walls), direction, raised, walls)
        station, memory = given.localiser(params).update(before.localiser, obs, driven, params, None)
        return Located(walls, direction, memory, station)


@struct.dataclass
class Given:
    """The ingredients of a memory."""

    weights: Any = None  # of the learnt localiser, as `locate.memory.init` makes them; None without one
    # the map as the learnt localiser takes it, or a filter on it in its place; None has none
    map: MapStrip | HistogramLocaliser | None = None
    blind: bool = struct.field(pytree_node=False, default=False)  # cut what the walls tell: an ablation

    def localiser(self, params: EnvParams) -> Any:
        if isinstance(self.map, HistogramLocaliser):
            return self.map
        locator = Locator(self.weights, self.map, self.blind)
        return TwoWays(locator) if params.goal_kind == "return" else locator
