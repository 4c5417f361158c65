"""Learning a sensor: which of many ways a stretch of scans belongs to, by cross entropy after every scan of it."""

import dataclasses
import itertools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

import subterra_jax as st
from subterra_jax.baselines.wallmap import WallMap, wall_map
from subterra_jax.policies import belief_scan
from subterra_jax.policies.belief import KIND, Habits
from subterra_jax.policies.belief_scan import N_FEATURES
from subterra_jax.rules import Relocalise
from train import devices, learning
from train.belief import lessons
from train.config import (
    ConfigError,
    TrainConfig,
    at_least,
    check_common,
    known_preset,
    not_negative,
    positive,
    share,
)
from train.learning import TrainState
from train.report import Finished, Report, report


@dataclasses.dataclass(frozen=True)
class BeliefConfig(TrainConfig):
    """Settings of a learnt sensor; of PPO's own, advantage, trust region and exploration are not used.

    Attributes:
        ways: Ways beside the true one that a lesson compares it with.
        least_apart: Ways nearer to the true one than this are no mistake, m.
        hidden: Widths of the network that weighs one beam.
        habits: Settings of the filter; not learnt, and written into the policy.
    """

    steps: int = 6_000_000
    n_envs: int = 128
    unroll: int = 128
    epochs: int = 4
    minibatches: int = 8
    learning_rate: float = 3e-3
    max_grad_norm: float = 1.0
    stop_coverage: float = 2.0
    checkpoint_every: int = 50
    ways: int = 127
    least_apart: float = 0.2
    hidden: tuple[int, ...] = (16,)
    habits: Habits = dataclasses.field(default_factory=Habits)

    KEEPS_BEST: ClassVar[bool] = False


_PRESETS: dict[str, dict[str, Any]] = {
    "gpu": {},
    "cpu": {"steps": 400_000, "n_envs": 16, "unroll": 64, "epochs": 2, "minibatches": 2, "ways": 63},
}


def make_belief_config(preset: str) -> BeliefConfig:
    """Returns the settings for one kind of machine.

    Raises:
        ConfigError: There is no preset of that name.
    """
    known_preset(preset)
    return BeliefConfig(**_PRESETS[preset])


def check_belief(config: BeliefConfig) -> BeliefConfig:
    """Refuses settings that make no sense, and returns the others.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    check_common(config)
    at_least(config, 1, "ways")
    positive(config, "least_apart")
    if not config.hidden or min(config.hidden) < 1:
        raise ConfigError(f"hidden must name at least one width, all at least 1, got {config.hidden}")
    positive(config.habits, "cell", "sure_mass", "furthest")
    not_negative(config.habits, "drift", "lost_drift", "leak", "sure_for")
    share(config.habits, "sure_mass", "furthest", "leak")
    return config


Weights = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class BeliefLayout:
    """Shapes of all arrays and meaning of the outputs; a checkpoint carries it.

    Attributes:
        action_low: Smallest action, m/s and rad/s.
        action_high: Largest action, m/s and rad/s.
        hidden: Widths of the network.
        habits: Fields of `subterra_jax.policies.belief.Habits`.
    """

    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    hidden: tuple[int, ...]
    habits: dict[str, float]


class BeliefNetworks:
    """The sensor's weights.

    Attributes:
        layout: Their layout.
    """

    kind = KIND

    def __init__(self, layout: BeliefLayout) -> None:
        self.layout = layout

    def init(self, key: PRNGKeyArray) -> Weights:
        """Returns untrained weights: the nominal likelihood with the particle filter's exponent, and no more."""
        widths = (N_FEATURES, *self.layout.hidden, 1)
        layers = {}
        for index, (n, m) in enumerate(itertools.pairwise(widths)):
            last = index == len(widths) - 2
            kernel = jax.random.normal(jax.random.fold_in(key, index), (n, m)) * jnp.sqrt(2.0 / n)
            layers[f"hidden_{index}"] = {"kernel": 0.0 * kernel if last else kernel, "bias": jnp.zeros(m)}
        return {"scan": layers, "temper": jnp.zeros(()), "nominal": jnp.log(0.5)}

    def policy_shapes(self) -> Any:
        """Returns a policy with shapes in place of arrays."""
        return jax.eval_shape(self.init, jax.random.PRNGKey(0))


def named(weights: Weights) -> dict[str, Any]:
    """Returns the weights by the names that `subterra_jax.policies.belief_scan` knows."""
    layers = {f"scan.{name}.{part}": leaf for name, layer in weights["scan"].items() for part, leaf in layer.items()}
    return {**layers, "temper": weights["temper"], "nominal": weights["nominal"]}


def layout_of(env: Any, params: Any, config: BeliefConfig) -> BeliefLayout:
    """Returns the layout that a checkpoint and a released policy carry."""
    bounds = env.action_space(params)
    return BeliefLayout(
        action_low=tuple(float(x) for x in bounds.low[:2]),
        action_high=tuple(float(x) for x in bounds.high[:2]),
        hidden=tuple(config.hidden),
        habits=dataclasses.asdict(config.habits),
    )


_OUTSIDE = -3.0  # log likelihood of a scan from beyond a mouth


class BeliefLearner(devices.Whole):
    """Training as two pure functions, `init` and `iterate`, for one environment and config.

    Args:
        env: An environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        axes: Names of the axes along which `iterate` is vmapped.
        split: Names of the axes along which environments are split; see `devices.Spread`.

    Raises:
        ConfigError: A setting makes no sense, or the task is not to find out where one is.
    """

    state_type = TrainState

    def __init__(
        self, env: Any, params: Any, config: BeliefConfig, axes: devices.Parts = (), split: devices.Parts = ()
    ) -> None:
        self.config, self.axes, self.split = check_belief(config), axes, split
        if not isinstance(env.rule, Relocalise):
            raise ConfigError(f"a belief over a map is learnt where one is put down anywhere, which {env.id} does not")
        self.env, self.map = st.batch.AutoReset(env, axes=axes), wall_map(params.tunnel)
        self.networks = BeliefNetworks(layout_of(env, params, config))
        self.optimizer = learning.clipped_adam(config, final_share=0.02)

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """Makes an untrained sensor, and starts an episode in every environment."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        weights = self.networks.init(key_weights)
        drive = lessons.begin(self.env, params, devices.own_key(key_reset, self.split), self.config.part_envs)
        return TrainState(weights, self.optimizer.init(weights), drive, key_rest, jnp.int32(0))

    def policy_of(self, state: TrainState) -> Weights:
        """Returns the sensor that would be used next."""
        return state.weights

    def iterate(self, state: TrainState, params: Any) -> tuple[TrainState, Report]:
        """Drives one unroll and learns from it."""
        config = self.config
        key, key_drive, key_learn = jax.random.split(state.key, 3)
        own = devices.own_key(key_drive, self.split)
        drive, stretch = lessons.collect(self.env, params, state.drive, own, config.unroll)

        def minibatch(now: tuple[Any, Any], chosen: Array, keys: Array) -> tuple[Any, tuple[Any, Any]]:
            part = jax.tree.map(lambda x: x[:, chosen], stretch)
            gradients, (losses, found) = jax.grad(self._loss, has_aux=True)(now[0], part, keys, params)
            gradients, losses = devices.mean_over_parts((gradients, losses), self.split)
            return learning.descend(self.optimizer, now, gradients), (losses, found)

        def own_keys(key: PRNGKeyArray, shape: tuple[int, ...]) -> Array:
            return jax.random.split(devices.own_key(key, self.split), shape)

        (weights, moments), (losses, found) = learning.run_epochs(
            minibatch, (state.weights, state.moments), config, key_learn, own_keys
        )
        metrics = {**jax.tree.map(jnp.mean, losses), "temper": jnp.exp(weights["temper"])}
        after = TrainState(weights, moments, drive, key, state.iteration + 1)
        told = _as_episodes(jax.tree.map(lambda x: x[0].reshape(-1), found), config.unroll)
        return after, report(told, metrics, self.policy_of(state))

    def _loss(
        self, weights: Weights, stretch: lessons.Stretch, keys: Array, params: Any
    ) -> tuple[Float[Array, ""], tuple[dict[str, Array], dict[str, Array]]]:
        """Returns the mean cross entropy of the true way, and the end of each lesson."""
        each, last, won = jax.vmap(lambda one, key: self._lesson(weights, one, key, params), (1, 0))(stretch, keys)
        count = jnp.maximum(jnp.sum(stretch.same), 1)
        loss = jnp.sum(each * stretch.same.T) / count
        losses = {"loss": loss, "belief": jnp.mean(jnp.exp(-last)), "found": jnp.mean(won)}
        return loss, (losses, {"won": won, "log_belief": -last})

    def _lesson(
        self, weights: Weights, stretch: lessons.Stretch, key: PRNGKeyArray, params: Any
    ) -> tuple[Float[Array, "time"], Float[Array, ""], Array]:
        """Returns one lesson's cross entropy at each time and at its end, and True if the true way has won by then."""
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
        """Returns the log likelihood of each scan on each way, and the ways that are wrong."""
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


def _as_episodes(found: dict[str, Array], unroll: int) -> Finished:
    """Logs lessons as episodes: a success where the true way won, the log of the belief in it as return."""
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
