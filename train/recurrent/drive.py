"""One unroll of every environment with memory, its storage, and the layout of the network it asks for."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

import subterra_jax as st
from subterra_jax.baselines.agent import n_ranges
from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.policies import senses
from train.config import ConfigError
from train.recurrent.config import RecurrentConfig
from train.recurrent.network import Kept, RecurrentLayout, RecurrentNetworks, Thought, Weights
from train.report import Finished


@struct.dataclass
class Drive:
    """State of the environments between two unrolls.

    Attributes:
        env_state: State of the batch of environments.
        observation: To act upon next.
        reckoning: Dead reckoning and rings of each episode so far.
        hidden: Memory.
        first: The observation begins an episode.
        episode_return: Undiscounted reward of each episode so far.
    """

    env_state: Any
    observation: Float[Array, "env obs"]
    reckoning: senses.Reckoning
    hidden: Float[Array, "env hidden"]
    first: Bool[Array, "env"]
    episode_return: Float[Array, "env"]


@struct.dataclass
class Rollout:
    """Storage of one unroll, `(time, env, …)`.

    Attributes:
        features: Inputs of the network.
        first: The episode begins with this step.
        ahead: Goal less tracked distance, m.
        error: True less tracked distance, m: what the estimation head is to learn.
        truth: Inputs of the critic.
        raw_action: The draw before the tanh.
        log_prob: Its log density when it was drawn.
        reward: Reward of the environment.
        terminated: The episode ended for good.
        truncated: The episode ended by the clock.
    """

    features: Kept
    first: Bool[Array, "time env"]
    ahead: Float[Array, "time env"]
    error: Float[Array, "time env"]
    truth: Float[Array, "time env n"]
    raw_action: Float[Array, "time env action"]
    log_prob: Float[Array, "time env"]
    reward: Float[Array, "time env"]
    terminated: Bool[Array, "time env"]
    truncated: Bool[Array, "time env"]


def look(
    env: Any, params: Any, observation: Float[Array, "env obs"], reckoning: senses.Reckoning
) -> tuple[senses.Sight, Kept]:
    """Looks at a batch of observations; returns what is seen, and the inputs of the network."""
    part = {name: observation[..., where] for name, where in env.fields(params).items()}
    if "scan" in part:
        part["ranges"] = level_ring(part["scan"], params.lidar.shape)
    view = senses.look(part, params.start.station, reckoning)
    # Side by side they would be copied, and cut apart again, at every step.
    return view, Kept(view.features, part["scan"] / senses.IMAGE_RANGE if "scan" in part else None)


def one_moment(inputs: Kept) -> Kept:
    """Returns the inputs of a moment as a sequence of one."""
    return jax.tree.map(lambda part: part[None], inputs)


def truth(env: Any, params: Any, state: Any, view: senses.Sight, error: Float[Array, "env"]) -> Float[Array, "env n"]:
    """Returns the critic's inputs: the true state, and the error of the agent's estimate of it.

    Args:
        env: The environment.
        params: Its params.
        state: Batched state.
        view: The agent's look at its observation.
        error: The agent's own estimate of true less tracked distance, m.
    """
    known = jax.vmap(env.privileged, (0, None))(state, params)
    ahead = known["to_goal"]
    wrong = view.station + params.start.station + error - known["station"]
    parts = [
        known["offset"],
        known["heading_sin"],
        known["heading_cos"],
        jnp.tanh(ahead),
        jnp.tanh(ahead / 10.0),
        ahead / 100.0,
        jnp.tanh(wrong),
        wrong / 5.0,
        10.0 * known["slip"],
        known["still"] / 10.0,
        *jnp.moveaxis(state.command, -1, 0),
    ]
    return jnp.stack(parts, axis=-1)


def begin(env: Any, params: Any, key: PRNGKeyArray, n_envs: int, layout: RecurrentLayout) -> Drive:
    """Starts an episode in every environment."""
    observation, state = env.reset(key, params, n_envs)
    return Drive(
        env_state=state,
        observation=observation,
        reckoning=senses.start((n_envs,), n_ranges(params), layout.shown),
        hidden=jnp.zeros((n_envs, layout.hidden)),
        first=jnp.ones(n_envs, bool),
        episode_return=jnp.zeros(n_envs),
    )


@dataclasses.dataclass(frozen=True)
class ForwardPass:
    """Forward pass of the network for one step of every environment.

    Attributes:
        view: Look at the observation.
        inputs: Inputs of the network.
        hidden: Memory after them.
        thought: Outputs of the heads.
    """

    view: senses.Sight
    inputs: Kept
    hidden: Float[Array, "env hidden"]
    thought: Thought


def think(env: Any, params: Any, networks: RecurrentNetworks, weights: dict[str, Weights], now: Drive) -> ForwardPass:
    """Runs the network on the observations to act upon next."""
    view, inputs = look(env.env, params, now.observation, now.reckoning)
    hidden, _ = networks.remember(weights, one_moment(inputs), now.hidden, now.first[None])
    return ForwardPass(view, inputs, hidden, networks.think(weights, hidden, view.ahead))


def mean_errors(station: Float[Array, "env"], view: senses.Sight, thought: Thought) -> dict[str, Float[Array, ""]]:
    """Averages how far off estimate, ring tracker and dead reckoning are, m; `station` is true, from the start."""
    error = station - view.station
    return {
        "estimate_error": jnp.mean(jnp.abs(error - thought.error)),
        "tracking_error": jnp.mean(jnp.abs(error)),
        "reckoning_error": jnp.mean(jnp.abs(station - view.reckoning.rings.reckoned)),
    }


def follow(
    now: Drive, stepped: Any, view: senses.Sight, hidden: Float[Array, "env hidden"], action: Float[Array, "env action"]
) -> tuple[Drive, Finished]:
    """Returns the environments after a step, and the episodes that it ended.

    Args:
        now: Before the step.
        stepped: Result of the step of the batch.
        view: Inputs that the action was chosen by.
        hidden: Memory after them.
        action: Action taken.
    """
    observation, state, reward, terminated, truncated, info = stepped
    done, total = terminated | truncated, now.episode_return + reward
    length = now.env_state.steps + 1
    finished = Finished(done, info["coverage"], info["success"], info["contact"], total, length)
    after = Drive(
        env_state=state,
        observation=observation,
        reckoning=senses.advance(view.reckoning, action, done),
        hidden=hidden,
        first=done,
        episode_return=jnp.where(done, 0.0, total),
    )
    return after, finished


def collect(
    env: Any,
    params: Any,
    networks: RecurrentNetworks,
    weights: dict[str, Weights],
    drive: Drive,
    key: PRNGKeyArray,
    n_steps: int,
) -> tuple[Drive, Rollout, Finished, dict[str, Float[Array, ""]]]:
    """Drives `n_steps` control periods with the sampled policy.

    Returns:
        State of the environments afterwards, the stored unroll, the episodes that ended in it, and means per step: of
        every reward term, and of how far off estimate, ring tracker and dead reckoning are (m).
    """

    def step(now: Drive, key_now: PRNGKeyArray) -> tuple[Drive, tuple[Rollout, Finished, dict[str, Array]]]:
        key_action, key_env = jax.random.split(key_now)
        forward = think(env, params, networks, weights, now)
        view, thought = forward.view, forward.thought
        raw = networks.distribution.sample_no_postprocessing(thought.parameters, key_action)
        action = networks.action(raw)
        stepped = env.step(key_env, now.env_state, action, params)
        _, _, reward, terminated, truncated, info = stepped
        station = now.env_state.station - params.start.station
        stored = Rollout(
            features=networks.keep(forward.inputs),
            first=now.first,
            ahead=view.ahead,
            error=station - view.station,
            truth=truth(env.env, params, now.env_state, view, thought.error),
            raw_action=raw,
            log_prob=networks.distribution.log_prob(thought.parameters, raw),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
        )
        terms = {
            **mean_errors(station, view, thought),
            **{name: jnp.mean(value) for name, value in info.items() if name.startswith("reward_")},
        }
        after, finished = follow(now, stepped, view, forward.hidden, action)
        return after, (stored, finished, terms)

    after, (stored, finished, terms) = jax.lax.scan(step, drive, jax.random.split(key, n_steps))
    return after, stored, finished, jax.tree.map(jnp.mean, terms)


_SLACK = 0.25


def require_goal(env: Any) -> None:
    """Refuses a task that such a network cannot do.

    Raises:
        ConfigError: The task has no goal.
    """
    if env.rule.errand not in ("stop", "return"):
        raise ConfigError(f"memory = gru learns to drive to a goal and stop, which {env.id} does not ask for")


def make_layout(env: Any, params: Any, config: RecurrentConfig) -> RecurrentLayout:
    """Returns the layout that `config` asks for on this environment; compiles nothing."""
    bounds, shown = env.action_space(params), senses_of(params, config)
    observation = jax.ShapeDtypeStruct((1, env.observation_size(params)), jnp.float32)
    batch = st.batch.AutoReset(env)
    shapes = jax.eval_shape(lambda obs: _shapes(env, batch, params, obs, shown), observation)
    return RecurrentLayout(
        n_features=sum(part.shape[-1] for part in jax.tree.leaves(shapes[0])),
        n_truth=shapes[1].shape[-1],
        # To stand must not lie at the end of a tanh; the environment reads a speed below 0 as 0.
        action_low=(float(bounds.low[0]) - _SLACK * float(bounds.high[0]), float(bounds.low[1])),
        action_high=tuple(float(bound) for bound in bounds.high[:2]),
        hidden=config.hidden,
        bins=config.bins,
        bin_width=config.bin_width,
        init_std=config.init_std,
        min_std=config.min_std,
        tracker=shown.tracker,
        boxes=shown.boxes,
        image=env.images(params).get("scan"),
        half=config.half,
    )


def senses_of(params: Any, config: RecurrentConfig) -> senses.Senses:
    """Chooses the network's inputs: those of the config, else those that suit the task."""
    among_boxes = "obstacles" in params.parts
    return senses.Senses(config.tracker or ("careful" if among_boxes else senses.PLAIN.tracker), among_boxes)


def _shapes(env: Any, batch: Any, params: Any, observation: Array, shown: senses.Senses) -> tuple[Kept, Array]:
    _, state = batch.reset(jax.random.key(0), params, 1)
    view, inputs = look(env, params, observation, senses.start((1,), n_ranges(params), shown))
    return inputs, truth(env, params, state, view, jnp.zeros(1))
