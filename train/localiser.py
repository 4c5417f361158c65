"""The auxiliary target of `--memory along`: the localiser learns the true station of drives that the policy steers."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.policies.locate import memory, streams
from subterra_jax.policies.locate.map_strip import MapStrip
from train import devices
from train.config import TrainConfig
from train.devices import Parts
from train.driver import Driver, Policy
from train.drives import Drives, record_drives
from train.map_target import MapCase, draw_cases, map_loss

_WARM = 50.0  # steps of the optimiser
_LAST_RATE = 0.02  # of the learning rate, at the end
_SHORT = 30  # metres; errors over so short a way count too
_FAR = 100  # metres from which on the fraction of right estimates is logged
_MOST = 5.0  # standard scales of an error beyond which a single drive has no further say
_CHUNK = 16  # drives whose gradients are computed at once


@struct.dataclass
class LocaliserState:
    """State of a localiser that learns."""

    weights: Any  # as `locate.memory.init` makes them
    moments: Any  # state of its optimiser
    steps: Int[Array, ""]  # steps of the optimiser


class LocaliserLearner:
    """Learning as pure functions.

    Args:
        driver: What drives.
        params: Parameters of its environment.
        config: Settings.
        split: Names of the axes along which drives are split.
        map: Maps of the tunnels, where the localiser learns to take one; None learns none.
    """

    def __init__(
        self, driver: Driver, params: Any, config: TrainConfig, split: Parts = (), map: MapStrip | None = None
    ) -> None:
        self.driver, self.config, self.split, self.map = driver, config, split, map
        self.n_metres = int(config.drive_steps * float(params.vehicle.period) * float(params.vehicle.speed_max))
        self.n_drives = config.drives // config.parts
        self.minibatch = math.gcd(self.n_drives, config.drives_minibatch)
        self.chunk = math.gcd(self.minibatch, _CHUNK)
        self.optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(b2=0.99))

    def init(self, key: PRNGKeyArray, given: Any = None) -> LocaliserState:
        """Returns the state before learning, with the weights given where there are some."""
        weights = memory.init(self.config.front, key, self.map is not None)
        weights = {**weights, **({} if given is None else given)}
        # Of definite types, as they come out of an iteration, or the second one is compiled anew.
        weights = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), weights)
        return LocaliserState(weights, self.optimizer.init(weights), jnp.zeros((), jnp.int32))

    def learn(
        self, state: LocaliserState, policy: Policy, params: Any, key: PRNGKeyArray, iteration: Array
    ) -> tuple[LocaliserState, dict[str, Array]]:
        """Records drives of a policy and learns from them."""
        config = self.config
        key_drive, key_order = jax.random.split(devices.own_key(key, self.split))
        drives = record_drives(self.driver, policy, params, key_drive, self.n_drives, config.drive_steps)
        given = None
        if self.map is not None:
            given = draw_cases(jax.random.fold_in(key_drive, 1), drives, params)
        rate = optax.cosine_decay_schedule(config.localiser_rate, config.iterations, _LAST_RATE)(iteration)

        def one(now: LocaliserState, index: Array) -> tuple[LocaliserState, dict[str, Array]]:
            part = jax.tree.map(lambda leaf: leaf[index], (drives, given))
            (loss, terms), gradients = devices.mean_over_parts(self._gradients(now.weights, part), self.split)
            finite = jnp.isfinite(optax.global_norm(gradients))
            gradients = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradients)
            updates, moments = self.optimizer.update(gradients, now.moments)
            warm = jnp.minimum(1.0, (now.steps + 1.0) / _WARM)
            weights = jax.tree.map(lambda w, u: w - rate * warm * u, now.weights, updates)
            return LocaliserState(weights, moments, now.steps + 1), {"loss": loss, **terms}

        order = jax.random.permutation(key_order, self.n_drives).reshape(-1, self.minibatch)
        state, terms = jax.lax.scan(one, state, order)
        return state, {f"station_{name}": jnp.nanmean(value) for name, value in terms.items()}

    def _gradients(
        self, weights: Any, part: tuple[Drives, MapCase | None]
    ) -> tuple[tuple[Array, dict[str, Array]], Any]:
        """Returns loss, what is logged, and gradients of a minibatch, summed over its chunks."""
        valid = jax.vmap(lambda record: streams.reached(record, self.n_metres))(part[0].record)
        counts = count(valid)
        chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, self.chunk, *leaf.shape[1:]), part)
        gradient = jax.value_and_grad(self._loss, has_aux=True)

        def add(total: Any, chunk: tuple[Drives, MapCase | None]) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, total, gradient(weights, *chunk, counts)), None

        shapes = jax.eval_shape(gradient, weights, *jax.tree.map(lambda leaf: leaf[0], chunks), counts)
        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        return jax.lax.scan(add, zero, chunks)[0]

    def _loss(
        self, weights: Any, drives: Drives, given: MapCase | None, counts: list[Array]
    ) -> tuple[Array, dict[str, Array]]:
        """Returns a chunk's part of the negative log likelihood of the true stations, and of what is logged."""
        answers, truth, valid = jax.vmap(lambda d: estimate(weights, d, self.n_metres))(drives)
        total, terms = station_loss(answers, truth, valid, counts)
        if given is None or self.map is None:
            return total, terms
        strip = self.map

        def one(drive: Drives, given: MapCase, answers: Any, truth: Array, valid: Array) -> Any:
            return map_loss(weights, drive, given, answers, truth, valid, strip)

        taught, further = jax.vmap(one)(drives, given, answers, truth, valid)
        terms |= {name: jnp.sum(value) / counts[0] for name, value in further.items()}
        return total + jnp.sum(taught) / counts[0], terms


def count(valid: Bool[Array, "env metre"]) -> list[Array]:
    """Returns the metres in a minibatch: all, those `_SHORT` m or more from the start, and those `_FAR` m or more."""
    return [jnp.maximum(jnp.sum(some), 1.0) for some in (valid, valid[:, _SHORT:], valid[:, _FAR:])]


def station_loss(answers: Any, truth: Array, valid: Array, counts: list[Array]) -> tuple[Array, dict[str, Array]]:
    """Returns a chunk's part of the negative log likelihood of the true stations, and of what is logged.

    Args:
        answers: Estimates of the metres of drives.
        truth: True less commanded distance, m.
        valid: Metres that were completed.
        counts: Of `count`, of the whole minibatch.
    """
    error = answers.correction - truth
    scaled = jnp.abs(error) * jnp.exp(-answers.log_scale)
    robust = jnp.where(scaled < _MOST, scaled, _MOST * (1.0 + jnp.log(jnp.maximum(scaled, _MOST) / _MOST)))
    short = jnp.minimum(jnp.abs(error[:, _SHORT:] - error[:, :-_SHORT]), 1.0)
    total = _sum(robust + answers.log_scale, valid) / counts[0] + _sum(short, valid[:, _SHORT:]) / counts[1]
    near = _sum(jnp.abs(error) < 1.0, valid & (jnp.arange(truth.shape[-1]) >= _FAR)) / counts[2]
    return total, {"error": _sum(jnp.abs(error), valid) / counts[0], "within": near}


def estimate(weights: Any, drive: Drives, n: int) -> tuple[Any, Array, Array]:
    """Returns answers, truth (m) and whether each metre was completed, of one drive."""
    blocks = streams.metres(drive.record, weights.get("match"), n)
    ends = jnp.arange(1.0, n + 1.0)
    truth = jnp.interp(ends, drive.record.driven, drive.moved) - ends
    return memory.sequence(weights, blocks), truth, streams.reached(drive.record, n)


def _sum(values: Array, valid: Bool[Array, "env metre"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(valid, values, 0.0))
