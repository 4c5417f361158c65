"""A learnt localiser as the robot goes: the same metres as in training, one at a time."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.stations import Driven, Localiser, Station, believed_start
from subterra_jax.policies.locate import bends, map_filter, matching, memory, profiles, strips
from subterra_jax.policies.locate.blocks import DELAY, Block, Estimate
from subterra_jax.policies.locate.map_strip import MapStrip
from subterra_jax.policies.locate.profiles import BIN, BLOCK, REACH, WINDOW, Profiles

_TO_SIGMA = 1.2533  # standard deviation of a normal distribution over its mean absolute error
_NEWEST = int(REACH / BIN) + 3  # bins ahead of the robot that a point may count in
_STEP = 1.0  # m; no step is longer


@struct.dataclass
class LocatorMemory:
    """Memory of a learnt localiser."""

    begin: Float[Array, ""]  # believed station of the start, m
    driven: Float[Array, ""]  # commanded distance along the axis, m
    reading: Float[Array, ""]  # last reading of the odometer, m
    steps: Float[Array, ""]  # steps so far
    metres: Int[Array, ""]  # metres completed
    read_before: Float[Array, ""]  # reading at the end of the last metre, m, interpolated
    steps_before: Float[Array, ""]  # steps at that time, interpolated
    bend: Float[Array, ""]  # curvature of the tunnel, 1/m
    window: Profiles  # profiles about the robot
    cell: Any  # memory behind the front end
    estimate: Estimate  # its last answer, with what the map tells
    belief: map_filter.MapBelief | None  # belief of the filter that takes a map; None without one
    passed: Float[Array, ""]  # correction of the metres that all beams have passed, without the map, m


@struct.dataclass
class Locator(Localiser):
    """Estimates the station by commands, corrected by what it has learnt of the walls."""

    weights: Any  # as `memory.init` makes them, trained
    map: MapStrip | None = None  # the map; None has none
    # leave the evidence out: the ablation that shows what the walls tell
    blind: bool = struct.field(pytree_node=False, default=False)

    def begin(self, obs: Observed, params: Any) -> LocatorMemory:
        zero = jnp.zeros(())
        start, sigma = believed_start(obs, params)
        return LocatorMemory(
            begin=start,
            driven=zero,
            reading=obs.distance,
            steps=zero - 1.0,
            metres=jnp.zeros((), jnp.int32),
            read_before=obs.distance,
            steps_before=zero,
            bend=zero,
            window=profiles.blank(WINDOW, strips.n_sides(params.lidar)),
            cell=memory.start(),
            estimate=Estimate(zero, zero, jnp.log(jnp.full((), 0.05))),
            belief=None if self.map is None else map_filter.start(self.weights[memory.MAP], sigma),
            passed=zero,
        )

    def update(
        self, before: LocatorMemory, obs: Observed, driven: Driven, params: Any, known: Known
    ) -> tuple[Station, LocatorMemory]:
        """Takes in a step: adds the scan to the profiles, and asks the memory at the end of each metre."""
        at = before.driven + jnp.clip(driven.speed * params.vehicle.period * driven.cosine, 0.0, _STEP)
        now = dataclasses.replace(before, driven=at, reading=obs.distance, steps=before.steps + 1.0)
        ended = jnp.floor(at).astype(jnp.int32) > before.metres
        block, now = self._see(before, now, obs, driven, params)
        cell, estimate = memory.step(self.weights, before.cell, block)
        estimate, belief, passed = self._compare(before, now, estimate, params)
        after = dataclasses.replace(
            now,
            cell=cell,
            estimate=estimate,
            metres=before.metres + 1,
            read_before=before.read_before + block.read + 1.0,
            steps_before=before.steps_before + block.steps,
            belief=belief,
            passed=passed,
        )
        now = jax.tree.map(lambda new, old: jnp.where(ended, new, old), after, now)
        since = at - now.metres
        station = now.begin + at + now.estimate.correction + now.estimate.fraction * since
        log_sigma = now.estimate.log_scale + jnp.log(_TO_SIGMA)
        return Station(station, jnp.maximum(log_sigma, jnp.log(0.01)), driven.direction), now

    def _compare(
        self, before: LocatorMemory, now: LocatorMemory, plain: Estimate, params: Any
    ) -> tuple[Estimate, map_filter.MapBelief | None, Array]:
        """Returns the estimate after the metre that may have ended, with the map; the belief, and what is passed."""
        age = before.metres + 1.0
        if self.map is None or before.belief is None:
            return plain, before.belief, before.passed
        passed, block = memory.passed(plain, age), before.metres - DELAY
        weights = self.weights[memory.MAP]
        seen = profiles.cut(now.window, BLOCK * block - map_filter.MARGIN, map_filter.N_SEEN)
        here = self.map.of(params.tunnel)
        ratio = map_filter.metre(weights, seen, here, now.begin, block, passed, passed - before.passed)
        after = map_filter.advance(weights, before.belief, ratio, memory.log_rate(plain, age))
        belief = jax.tree.map(lambda new, old: jnp.where(block >= 0, new, old), after, before.belief)
        sigma = jnp.asarray(params.start.station_sigma, jnp.float32)
        return map_filter.corrected(belief, plain, age, sigma), belief, passed

    def _see(
        self, before: LocatorMemory, now: LocatorMemory, obs: Observed, driven: Driven, params: Any
    ) -> tuple[Block, LocatorMemory]:
        """Returns the metre that may have ended, and the memory with the scan."""
        walls = getattr(driven.walls, "corridor", driven.walls)  # steering round boxes keeps them with its hits
        points, bend = bends.look(before.bend, obs, walls, now.driven - before.driven, params)
        window = profiles.forget(before.window, _newest(before.driven), _newest(now.driven))
        window = profiles.add_points(window, points, (now.driven + points.along) / BIN, wrapped=True)
        metre = before.metres
        fraction = (metre + 1.0 - before.driven) / jnp.maximum(now.driven - before.driven, 1e-6)
        read = before.reading + fraction * (now.reading - before.reading)
        steps = before.steps + fraction
        match = self.weights["match"]
        if self.blind:
            evidence = jnp.zeros_like(match["shares"])
        else:
            first = BLOCK * (metre - DELAY) - matching.LAGS - matching.MARGIN
            found = matching.evidence(match, profiles.cut(window, first, matching.N_CUT))
            evidence = jnp.where(metre >= DELAY, found, 0.0)
        block = Block(evidence, read - before.read_before - 1.0, steps - before.steps_before)
        return block, dataclasses.replace(now, bend=bend, window=window)


def _newest(driven: Float[Array, ""]) -> Int[Array, ""]:
    """Returns the newest bin that a robot may put a point in."""
    return jnp.floor(driven / BIN).astype(jnp.int32) + _NEWEST
