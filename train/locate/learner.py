"""Learns a localiser by driving: the true station is the target, in training only."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax import constants
from subterra_jax.policies import load
from subterra_jax.policies.locate import map_filter, memory, streams, strips
from subterra_jax.policies.locate.agent import Locating, nested
from subterra_jax.policies.locate.blocks import DELAY
from subterra_jax.policies.locate.map_strip import MapStrip
from train.locate.drives import Drive, record_drives
from train.tunnels import PLANAR


@dataclasses.dataclass(frozen=True)
class LocateConfig:
    """Settings of a learnt localiser.

    Attributes:
        network: `kalman`, `gru`, `s5` or `transformer`; the latter with `-kalman` have their answers filtered.
        front: `match` compares what beams ahead and behind saw, `wide` for errors as large as wet rail makes them too;
            `scans` gives the network the scans themselves.
        n_envs: Drives recorded in one iteration.
        n_steps: Steps of each.
        minibatch: Drives in one step of the optimiser.
        chunk: Drives whose gradients are computed at once; more take more memory and give the same result.
        epochs: Times that each drive is learnt from.
        learning_rate: Of Adam, at most; it rises over the first steps and falls with the time that is left.
        max_grad_norm: Norm to which gradients are clipped.
        minutes: Time of the training, with compiling.
        speed: Full speed of the drives, m/s, and of the policy; None is that of the vehicle. A slow robot sees
            each metre more often, and takes more steps for it.
        begin_from: Localiser whose weights all seeds begin with, by name or file; it may be of another LiDAR, and have
            learnt without a map.
        map: Learn to take a map as well. What it does without one is learnt on the same drives.
        hidden: Share of the drives with a map whose start is hidden.
        wrong: Share of them that get a map of another place, which is not to be believed.
    """

    network: str = "kalman"
    front: str = "match"
    n_envs: int = 512
    n_steps: int = 900
    minibatch: int = 64
    chunk: int = 16
    epochs: int = 1
    learning_rate: float = 2e-3
    max_grad_norm: float = 1.0
    minutes: float = 20.0
    speed: float | None = None
    begin_from: str | None = None
    map: bool = False
    hidden: float = 0.5
    wrong: float = 0.2


@struct.dataclass
class TrainState:
    """State of a training.

    Attributes:
        weights: Of the localiser.
        moments: State of the optimiser.
        key: Source of all later randomness.
        steps: Steps of the optimiser.
    """

    weights: Any
    moments: Any
    key: PRNGKeyArray
    steps: Array


@struct.dataclass
class Told:
    """Start and map that a robot is told.

    Attributes:
        offset: True station of the start less that told, m.
        sigma: Standard deviation of the start that it is told, m.
        tunnel: Tunnel of its map.
        shift: Place on that map less the true one, m.
        right: Whether the map is the right one.
    """

    offset: Float[Array, "*env"]
    sigma: Float[Array, "*env"]
    tunnel: Int[Array, "*env"]
    shift: Float[Array, "*env"]
    right: Bool[Array, "*env"]


_WARM = 50.0  # steps of the optimiser
_SHORT = 30  # metres; errors over so short a way count too
_FAR = 100  # metres from which on the share of right estimates is logged
_APART = 50.0  # m from the true place to that of a wrong map, at least
_MOST = 5.0  # standard scales of an error beyond which a single drive has no further say


class LocateLearner:
    """Training as pure functions.

    Args:
        env: An environment that starts facing growing stations.
        params: Its parameters.
        config: Settings.
    """

    def __init__(self, env: Any, params: Any, config: LocateConfig) -> None:
        self.env, self.config = env, config
        speed = float(params.vehicle.speed_max if config.speed is None else config.speed)
        self.chunk = math.gcd(config.minibatch, config.chunk)
        self.n_metres = int(config.n_steps * float(params.vehicle.period) * speed)
        self.optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(b2=0.99))
        self.given = None if config.begin_from is None else begun(config, strips.n_sides(params.lidar))

    @staticmethod
    def check(config: LocateConfig) -> None:
        """Refuses a network or front end that there is not, and weights to begin with that do not fit.

        Raises:
            ValueError: There is no such one, or they are of another network or front end.
            PolicyError: There are no such weights.
        """
        jax.eval_shape(lambda key: memory.init(config.network, config.front, key, config.map), jax.random.key(0))
        if config.begin_from is not None:
            begun(config, 2)

    def init(self, seed: Array | int) -> TrainState:
        """Returns the state before training."""
        key_weights, key = jax.random.split(jax.random.key(seed))
        config = self.config
        weights = memory.init(config.network, config.front, key_weights, config.map)
        if self.given is not None:
            weights = {**weights, **self.given}  # one that learnt without a map has no weights for it
        # Of definite types, as they come out of an iteration, or the second one is compiled anew.
        weights = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), weights)
        return TrainState(weights, self.optimizer.init(weights), key, jnp.zeros((), jnp.int32))

    def iterate(
        self, state: TrainState, params: Any, left: Array, strip: MapStrip | None = None
    ) -> tuple[TrainState, dict[str, Array]]:
        """Records drives and learns from them.

        Args:
            state: The state before.
            params: Parameters of the environment.
            left: Share of the time that is left.
            strip: Maps of the tunnels, for a network that learns to take one.
        """
        config = self.config
        key, key_drive, key_order = jax.random.split(state.key, 3)
        drive = record_drives(self.env, params, key_drive, config.n_envs, config.n_steps, speed=config.speed)
        told = draw_told(jax.random.fold_in(key_drive, 1), drive, params, config) if config.map else None
        n_batches = config.n_envs // config.minibatch

        def one(carry: TrainState, index: Array) -> tuple[TrainState, dict[str, Array]]:
            part = jax.tree.map(lambda leaf: leaf[index], (drive, told))
            (loss, terms), gradients = self._gradients(carry.weights, part, strip)
            finite = jnp.isfinite(optax.global_norm(gradients))
            gradients = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradients)
            updates, moments = self.optimizer.update(gradients, carry.moments)
            warm = jnp.minimum(1.0, (carry.steps + 1.0) / _WARM)
            rate = config.learning_rate * warm * (0.02 + 0.98 * 0.5 * (1.0 - jnp.cos(jnp.pi * left)))
            weights = jax.tree.map(lambda w, u: w - rate * u, carry.weights, updates)
            return TrainState(weights, moments, carry.key, carry.steps + 1), {"loss": loss, **terms}

        orders = jax.vmap(lambda k: jax.random.permutation(k, config.n_envs))(
            jax.random.split(key_order, config.epochs)
        )
        state, terms = jax.lax.scan(one, state, orders.reshape(config.epochs * n_batches, config.minibatch))
        return dataclasses.replace(state, key=key), jax.tree.map(jnp.nanmean, terms)

    def _gradients(
        self, weights: Any, part: tuple[Drive, Told | None], strip: MapStrip | None
    ) -> tuple[tuple[Array, dict[str, Array]], Any]:
        """Returns loss, what is logged, and gradients of a minibatch, summed over its chunks."""
        valid = jax.vmap(lambda record: streams.reached(record, self.n_metres))(part[0].record)
        counts = count(valid)
        chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, self.chunk, *leaf.shape[1:]), part)
        gradient = jax.value_and_grad(self._loss, has_aux=True)

        def add(total: Any, chunk: tuple[Drive, Told | None]) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, total, gradient(weights, *chunk, counts, strip)), None

        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(
            gradient, weights, *jax.tree.map(lambda leaf: leaf[0], chunks), counts, strip))  # fmt: skip
        return jax.lax.scan(add, zero, chunks)[0]

    def _loss(
        self, weights: Any, drive: Drive, told: Told | None, counts: list[Array], strip: MapStrip | None
    ) -> tuple[Array, dict[str, Array]]:
        """Returns a chunk's part of the negative log likelihood of the true stations, and of what is logged.

        Args:
            weights: Of the localiser.
            drive: The chunk.
            told: What its robots are told; None teaches no map.
            counts: Of `count`, of the whole minibatch.
            strip: Maps of the tunnels.
        """
        network, n = self.config.network, self.n_metres
        answers, truth, valid = jax.vmap(lambda d: estimate(network, weights, d, n))(drive)
        total, terms = loss(answers, truth, valid, counts)
        if told is None or strip is None:
            return total, terms

        def one(drive: Drive, told: Told, answers: Any, truth: Array, valid: Array) -> tuple[Array, dict[str, Array]]:
            return map_loss(weights, drive, told, answers, truth, valid, strip)

        taught, further = jax.vmap(one)(drive, told, answers, truth, valid)
        terms |= {name: jnp.sum(value) / counts[0] for name, value in further.items()}
        return total + jnp.sum(taught) / counts[0], terms


def begun(config: LocateConfig, n_sides: int) -> Any:
    """Returns the weights of `begin_from`; their evidence is told as that of as many sides as they learnt on.

    Args:
        config: Settings.
        n_sides: Sides that the points of the LiDAR are of.

    Raises:
        ValueError: They are of another network or front end, or of no localiser.
        PolicyError: There are no such weights.
    """
    agent, facts = load(config.begin_from or "")
    if not isinstance(agent, Locating):
        raise ValueError(f"begin_from = {config.begin_from}: is no localiser, but {type(agent).__name__}")
    found = (agent.network, memory.front_of(agent.tensors))
    if found != (config.network, config.front):
        raise ValueError(
            f"begin_from = {config.begin_from}: is of network {found[0]} with front {found[1]}, "
            f"not {config.network} with {config.front}"
        )
    weights = nested(agent.tensors)
    if not config.map:
        weights.pop(memory.MAP, None)
    if "match" in weights:  # the evidence of all sides is summed
        learnt_on = 2 if facts.get("world", {}).get("sensor", PLANAR) == PLANAR else 2 * len(strips.HEIGHTS)
        weights["match"]["count"] = weights["match"]["count"] + math.log(learnt_on / n_sides)
    return weights


def draw_told(key: PRNGKeyArray, drive: Drive, params: Any, config: LocateConfig) -> Told:
    """Draws what each robot with a map is told: a hidden start or not, the right map or one of another place."""
    keys, shape = jax.random.split(key, 4), drive.start.shape
    hidden, wrong = (jax.random.uniform(k, shape) for k in keys[:2])
    sigma = jnp.where(hidden < config.hidden, constants.HIDDEN_START_SIGMA, 0.0)
    offset = sigma * jnp.clip(jax.random.normal(keys[2], shape), -3.0, 3.0)
    right = wrong >= config.wrong
    count = params.tunnel.count
    ways = jax.random.uniform(keys[3], (2, *shape))
    # Of one tunnel the other place is another part of it.
    other = (drive.tunnel + 1 + jnp.floor(ways[0] * (count - 1)).astype(jnp.int32)) % count
    room = jnp.broadcast_to(jnp.asarray(params.tunnel.length), (count,))[other]
    away = jnp.mod(drive.start + _APART + ways[1] * jnp.maximum(room - 2.0 * _APART, 0.0), room) - drive.start
    return Told(offset, sigma, jnp.where(right, drive.tunnel, other), jnp.where(right, 0.0, away), right)


def map_loss(
    weights: Any, drive: Drive, told: Told, answers: Any, truth: Array, valid: Array, strip: MapStrip
) -> tuple[Array, dict[str, Array]]:
    """Returns the negative log probability of shift and map, summed over the metres of one drive, and what is logged.

    Args:
        weights: Of the localiser.
        drive: The drive.
        told: What its robot is told.
        answers: The localiser's own answers, which learn nothing of this.
        truth: True less commanded distance, m.
        valid: Metres that were completed.
        strip: Maps of the tunnels.
    """
    beliefs, passed = believe(weights, drive, told, jax.lax.stop_gradient(answers), strip)
    shift = told.offset + truth[: len(truth) - DELAY] - passed[DELAY:]
    right = jnp.broadcast_to(told.right, shift.shape)
    score = jax.vmap(map_filter.likelihood)(jax.tree.map(lambda leaf: leaf[DELAY:], beliefs), shift, right)
    use = valid[DELAY:] & (jnp.abs(shift) < map_filter.SHIFTS[-1])
    found, _, believed = jax.vmap(map_filter.place)(beliefs)
    near = jnp.abs(found[DELAY:] - shift) < 1.0
    terms = {"mapped": jnp.sum(use & told.right & near), "misled": jnp.sum(use & ~told.right & believed[DELAY:])}
    return -jnp.sum(jnp.where(use, score, 0.0)), jax.tree.map(lambda n: n.astype(jnp.float32), terms)


def believe(weights: Any, drive: Drive, told: Told, answers: Any, strip: MapStrip) -> tuple[Any, Array]:
    """Returns the beliefs of a robot with a map after all metres of a drive, and the corrections that they are about.

    Args:
        weights: Of the localiser.
        drive: The drive.
        told: What it is told.
        answers: The localiser's own answers.
        strip: Maps of the tunnels.
    """
    age = jnp.arange(1.0, answers.correction.shape[0] + 1.0)
    passed, rate = memory.passed(answers, age), memory.log_rate(answers, age)
    whole = streams.profiles_of(drive.record, len(age))
    start = drive.start - told.offset + told.shift
    beliefs = map_filter.sequence(
        weights[memory.MAP], whole, streams.BEFORE, strip.pick(told.tunnel), start, told.sigma, passed, rate
    )
    return beliefs, passed


def count(valid: Bool[Array, "env metre"]) -> list[Array]:
    """Returns the metres in a minibatch: all, those `_SHORT` m or more from the start, and those `_FAR` m or more."""
    return [jnp.maximum(jnp.sum(some), 1.0) for some in (valid, valid[:, _SHORT:], valid[:, _FAR:])]


def loss(answers: Any, truth: Array, valid: Array, counts: list[Array]) -> tuple[Array, dict[str, Array]]:
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


def estimate(network: str, weights: Any, drive: Drive, n: int) -> tuple[Any, Array, Array]:
    """Returns answers, truth (m) and whether each metre was completed, of one drive."""
    blocks = streams.metres(drive.record, weights.get("match"), n)
    ends = jnp.arange(1.0, n + 1.0)
    truth = jnp.interp(ends, drive.record.driven, drive.moved) - ends
    return memory.sequence(network, weights, blocks), truth, streams.reached(drive.record, n)


def _sum(values: Array, valid: Bool[Array, "env metre"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(valid, values, 0.0))
