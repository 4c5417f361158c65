"""Learning a sensor: which of many ways a stretch of scans belongs to, by cross entropy after every scan of it."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st
from subterra_jax.baselines.wallmap import WallMap, wall_map
from subterra_jax.policies import belief_scan
from subterra_jax.rules import Relocalise
from train.belief import lessons
from train.belief.config import BeliefConfig, check
from train.belief.network import BeliefNetworks, Weights, named
from train.belief.world import layout_of
from train.devices import parts
from train.errors import ConfigError
from train.run.report import Finished, Report, report

_OUTSIDE = -3.0  # log likelihood of a scan from beyond a mouth


@struct.dataclass
class TrainState:
    """Everything that one iteration hands to the next.

    Attributes:
        weights: Of the sensor.
        moments: State of the optimiser.
        drive: Where the environments are.
        key: For everything random from here on.
        iteration: Iterations done.
    """

    weights: Weights
    moments: Any
    drive: lessons.Drive
    key: PRNGKeyArray
    iteration: Int[Array, ""]


class BeliefLearner(parts.Whole):
    """The two pure functions of training, `init` and `iterate`, for one environment and config.

    Args:
        env: An environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        axes: Names of the axes along which `iterate` is vmapped.
        split: Names of the axes along which environments are split; see `spread.py`.

    Raises:
        ConfigError: A setting makes no sense, or the task is not to find out where one is.
    """

    state_type = TrainState

    def __init__(
        self, env: Any, params: Any, config: BeliefConfig, axes: parts.Parts = (), split: parts.Parts = ()
    ) -> None:
        self.config, self.axes, self.split = check(config), axes, split
        if not isinstance(env.rule, Relocalise):
            raise ConfigError(f"a belief over a map is learnt where one is put down anywhere, which {env.id} does not")
        self.env, self.map = st.batch.AutoReset(env, axes=axes), wall_map(params.tunnel)
        self.networks = BeliefNetworks(layout_of(env, params, config))
        updates = config.iterations * config.epochs * config.minibatches
        rate = optax.cosine_decay_schedule(config.learning_rate, updates, alpha=0.02)
        self.optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """An untrained sensor and every environment at the start of an episode."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        weights = self.networks.init(key_weights)
        drive = lessons.begin(self.env, params, parts.own_key(key_reset, self.split), self.config.part_envs)
        return TrainState(weights, self.optimizer.init(weights), drive, key_rest, jnp.int32(0))

    def policy_of(self, state: TrainState) -> Weights:
        """The sensor that would be used next."""
        return state.weights

    def iterate(self, state: TrainState, params: Any) -> tuple[TrainState, Report]:
        """Drives one unroll and learns from it."""
        config = self.config
        key, key_drive, key_learn = jax.random.split(state.key, 3)
        own = parts.own_key(key_drive, self.split)
        drive, stretch = lessons.collect(self.env, params, state.drive, own, config.unroll)

        def minibatch(now: tuple[Any, Any], chosen: tuple[Array, Array]) -> tuple[Any, tuple[Any, Any]]:
            weights, moments = now
            part = jax.tree.map(lambda x: x[:, chosen[0]], stretch)
            gradients, (losses, found) = jax.grad(self._loss, has_aux=True)(weights, part, chosen[1], params)
            gradients, losses = parts.mean((gradients, losses), self.split)
            updates, moments = self.optimizer.update(gradients, moments)
            return (optax.apply_updates(weights, updates), moments), (losses, found)

        def epoch(now: tuple[Any, Any], key_now: PRNGKeyArray) -> tuple[Any, Any]:
            key_order, key_ways = jax.random.split(key_now)
            order = jax.random.permutation(key_order, config.part_envs).reshape(config.minibatches, -1)
            keys = jax.random.split(parts.own_key(key_ways, self.split), order.shape)
            return jax.lax.scan(minibatch, now, (order, keys))

        (weights, moments), (losses, found) = jax.lax.scan(
            epoch, (state.weights, state.moments), jax.random.split(key_learn, config.epochs)
        )
        metrics = {**jax.tree.map(jnp.mean, losses), "temper": jnp.exp(weights["temper"])}
        after = TrainState(weights, moments, drive, key, state.iteration + 1)
        told = _told(jax.tree.map(lambda x: x[0].reshape(-1), found), config.unroll)
        return after, report(told, metrics, self.policy_of(state))

    def _loss(
        self, weights: Weights, stretch: lessons.Stretch, keys: Array, params: Any
    ) -> tuple[Float[Array, ""], tuple[dict[str, Array], dict[str, Array]]]:
        """Mean cross entropy of the true way, and how each lesson ended."""
        each, last, won = jax.vmap(lambda one, key: self._lesson(weights, one, key, params), (1, 0))(stretch, keys)
        count = jnp.maximum(jnp.sum(stretch.same), 1)
        loss = jnp.sum(each * stretch.same.T) / count
        losses = {"loss": loss, "belief": jnp.mean(jnp.exp(-last)), "found": jnp.mean(won)}
        return loss, (losses, {"won": won, "log_belief": -last})

    def _lesson(
        self, weights: Weights, stretch: lessons.Stretch, key: PRNGKeyArray, params: Any
    ) -> tuple[Float[Array, "time"], Float[Array, ""], Array]:
        """Of one lesson: cross entropy at each time, that at its end, and whether the true way has won by then."""
        config, tunnel = self.config, params.tunnel.pick(stretch.tunnel[0])
        gain, wrong = self._gains(weights, self.map.pick(tunnel), stretch, tunnel, key, params)
        total = jnp.cumsum(gain * stretch.same[:, None], axis=0)
        # The first is the true one; others as near as a cell of it are neither right nor wrong.
        counted = wrong | (jnp.arange(config.ways + 1) == 0)
        each = jax.nn.logsumexp(jnp.where(counted, total, -jnp.inf), axis=1) - total[:, 0]
        end = jnp.sum(stretch.same) - 1
        won = total[end, 0] > jnp.max(jnp.where(wrong, total[end], -jnp.inf))
        return each, each[end], won

    def _gains(
        self, weights: Weights, walls: WallMap, stretch: lessons.Stretch, tunnel: Any, key: PRNGKeyArray, params: Any
    ) -> tuple[Float[Array, "time way"], Array]:
        """Log likelihood of each scan on each way, and which ways are wrong."""
        config, tensors = self.config, named(weights)
        ways = lessons.ways(
            key,
            stretch.station,
            stretch.forward[0],
            tunnel.length,
            tunnel.ring_pitch,
            config.ways,
            config.least_apart,
            0.5 * config.habits.cell,
        )
        range_max = jnp.asarray(params.lidar.range_max)

        @jax.checkpoint
        def scan(ranges: Array, corridor: Any, station: Float[Array, "way"]) -> Float[Array, "way"]:
            place = belief_scan.pose_at(corridor, station, ways.forward)
            gain = belief_scan.score(tensors, walls, place, ranges, range_max)
            return jnp.where((station > 0.0) & (station < tunnel.length), gain, _OUTSIDE)

        return jax.vmap(scan)(stretch.ranges, stretch.walls, ways.station), ways.wrong


def _told(found: dict[str, Array], unroll: int) -> Finished:
    """Lessons as the log has episodes: a success where the true way won, the log of the belief in it as return."""
    won, log_belief = found["won"], found["log_belief"]
    last = jnp.broadcast_to((jnp.arange(unroll) == unroll - 1)[:, None], (unroll, len(won)))
    over_time = lambda row: jnp.broadcast_to(row, last.shape)  # noqa: E731
    return Finished(
        done=last,
        coverage=over_time(jnp.exp(log_belief)),
        success=over_time(won),
        contact=jnp.zeros_like(last),
        episode_return=over_time(log_belief),
        length=jnp.full(last.shape, unroll, jnp.int32),
    )
