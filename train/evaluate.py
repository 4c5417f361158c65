"""Scores of a policy without its exploration noise: `python -m train.evaluate --policy DIR --task ID`."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.tunnel import at_station
from train import cli, compiling, frames, policies
from train.errors import ConfigError
from train.networks import Networks, Policy

EVALUATION_SEED = 1_000_000  # far from the seeds people train with


@struct.dataclass
class Outcome:
    """One finished episode.

    Attributes:
        coverage: Share of the tunnel covered, 0 to 1.
        success: Whether the goal was met.
        contact: Whether it ended at a wall.
        length: Steps.
        episode_return: Sum of rewards.
        offset: Mean distance from the centreline over the local half-width.
        jerk: Mean change of command per step, |Δv| + |Δω| in m/s and rad/s, as the reward counts it.
        travelled: Distance driven, m.
    """

    coverage: Float[Array, "*episode"]
    success: Bool[Array, "*episode"]
    contact: Bool[Array, "*episode"]
    length: Int[Array, "*episode"]
    episode_return: Float[Array, "*episode"]
    offset: Float[Array, "*episode"]
    jerk: Float[Array, "*episode"]
    travelled: Float[Array, "*episode"]


def drive(env: Any, params: Any, networks: Networks, policy: Policy, key: PRNGKeyArray, n_episodes: int) -> Outcome:
    """One episode from each of `n_episodes` starts.

    Episode i depends on the key and on i alone, not on how many are driven with it.
    """
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(n_episodes))
    observation, state = jax.vmap(env.reset, (0, None))(keys, params)
    blank = Outcome(
        *[jnp.zeros(n_episodes, kind) for kind in (float, bool, bool, jnp.int32, float, float, float, float)]
    )

    def unfinished(now: tuple[Any, ...]) -> Array:
        return ~jnp.all(now[3])

    def step(now: tuple[Any, ...]) -> tuple[Any, ...]:
        count, stack, state, done, so_far = now
        # 0 is taken by the reset, so that no draw is used twice.
        step_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, count + 1)
        observation, after, reward, terminated, truncated, info = jax.vmap(env.step, (0, 0, 0, None))(
            step_keys, state, networks.act(policy, stack), params
        )
        half_width = jax.vmap(at_station, (None, 0))(params.tunnel, info["station"])[:, 4]
        stepped = Outcome(
            coverage=info["coverage"],
            success=info["success"],
            contact=info["contact"],
            length=so_far.length + 1,
            episode_return=so_far.episode_return + reward,
            offset=so_far.offset + jnp.abs(info["lateral"]) / half_width,
            jerk=so_far.jerk + jnp.sum(jnp.abs(after.command - state.command), axis=-1),
            travelled=so_far.travelled + after.command[:, 0] * params.vehicle.period,
        )
        outcome = jax.tree.map(lambda old, new: jnp.where(done, old, new), so_far, stepped)
        stack = frames.push(stack, observation, jnp.zeros_like(done))
        return count + 1, stack, after, done | terminated | truncated, outcome

    begin = (jnp.int32(0), frames.start(observation, networks.layout.frames), state, blank.success, blank)
    outcome = jax.lax.while_loop(unfinished, step, begin)[-1]
    return dataclasses.replace(outcome, offset=outcome.offset / outcome.length, jerk=outcome.jerk / outcome.length)


def evaluate(env: Any, params: Any, networks: Networks, policy: Policy, n_episodes: int, seed: int) -> dict[str, Any]:
    """Summary of `n_episodes` episodes of the deterministic policy, as plain values.

    Args:
        env: The environment.
        params: Its parameters.
        networks: What the policy's weights belong to.
        policy: The policy.
        n_episodes: Episodes.
        seed: Fixes starts, odometry biases and every noise.

    Returns:
        `success` and `coverage` (means, shares), `coverage_min`, `offset` (mean |d|/w), `time` (mean, s), `jerk` (mean
        |Δv| + |Δω| per step), `contacts` (episodes that ended at a wall), `contacts_per_100m`, `episode_return` (mean).
    """
    if n_episodes < 1:
        raise ConfigError(f"episodes must be at least 1, got {n_episodes}")
    run = jax.jit(drive, static_argnums=(0, 2, 5), compiler_options=compiling.options())
    outcome = jax.device_get(run(env, params, networks, policy, jax.random.key(seed), n_episodes))

    def mean(values: Any) -> float:
        return float(np.mean(values, dtype=np.float64))

    contacts = int(outcome.contact.sum())
    return {
        "episodes": n_episodes,
        "seed": seed,
        "success": mean(outcome.success),
        "coverage": mean(outcome.coverage),
        "coverage_min": float(outcome.coverage.min()),
        "offset": mean(outcome.offset),
        "time": mean(outcome.length) * float(params.vehicle.period),
        "jerk": mean(outcome.jerk),
        "contacts": contacts,
        "contacts_per_100m": 100.0 * contacts / float(outcome.travelled.sum(dtype=np.float64)),
        "episode_return": mean(outcome.episode_return),
    }


@dataclasses.dataclass(frozen=True)
class Command:
    """Scores a trained policy without its exploration noise.

    Attributes:
        policy: Run folder of `train.navigate`, or one checkpoint in it.
        task: Task id; the one it was trained on if left out.
        tunnel: Tunnel file; the packaged tunnel if left out.
        lining: Variant of the walls; the one it was trained on if left out.
        episodes: Episodes to drive.
        seed: Fixes starts, odometry biases and every noise.
        json: One line of JSON instead of a table.
    """

    policy: Path
    task: str | None = None
    tunnel: Path | None = None
    lining: str | None = None
    episodes: int = 100
    seed: int = EVALUATION_SEED
    json: bool = False


def command(arguments: Command) -> None:
    """Evaluates and prints."""
    networks, policy, facts = policies.load_policy(arguments.policy)
    world = policies.open_world(
        arguments.task or facts["task"], arguments.tunnel, arguments.lining or facts["world"]["lining"]
    )
    policies.check_fits(networks.layout, world, arguments.policy)
    scores = evaluate(world.env, world.params, networks, policy, arguments.episodes, arguments.seed)
    if arguments.json:
        print(json.dumps({**world.facts, **scores}))
    else:
        cli.table(f"{world.task}, {arguments.policy.name}", scores)


def main() -> None:
    """Entry point of `python -m train.evaluate`."""
    cli.run(lambda: command(tyro.cli(Command)))


if __name__ == "__main__":
    main()
