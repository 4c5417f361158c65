"""The stack of the last few observations: kept while driving, rebuilt from unstacked storage while learning.

Storing one observation per step instead of the stack divides the memory of a rollout by the number of frames. Both ways
give the same stack, and the tests compare them.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def start(observation: Float[Array, "*batch obs"], n_frames: int) -> Float[Array, "*batch {n_frames} obs"]:
    """The stack at the first step of an episode: that observation, repeated."""
    return jnp.repeat(observation[..., None, :], n_frames, axis=-2)


def push(
    stack: Float[Array, "*batch frames obs"], observation: Float[Array, "*batch obs"], first: Bool[Array, "*batch"]
) -> Float[Array, "*batch frames obs"]:
    """The stack one observation later, oldest frame first.

    Args:
        stack: The stack so far.
        observation: The newest observation.
        first: Whether it begins an episode; the stack then holds nothing older.
    """
    moved = jnp.concatenate([stack[..., 1:, :], observation[..., None, :]], axis=-2)
    return jnp.where(first[..., None, None], start(observation, stack.shape[-2]), moved)


def rebuild(
    first_stack: Float[Array, "env frames obs"],
    observation: Float[Array, "time env obs"],
    age: Int[Array, "time env"],
) -> Float[Array, "time env frames obs"]:
    """The stacks that `push` kept during a rollout, from its unstacked observations.

    Args:
        first_stack: The stack at the first step of the rollout; its newest frame is `observation[0]`.
        observation: The observation acted upon at every step.
        age: Steps since that environment's episode began, 0 at its first observation.

    Returns:
        Stacks, oldest frame first. None reaches back across the beginning of its episode.
    """
    n_frames, n_steps = first_stack.shape[-2], observation.shape[0]
    history = jnp.moveaxis(first_stack[:, :-1], 1, 0)
    padded = jnp.concatenate([history, observation], axis=0)
    frames = [observation]
    for lag in range(1, n_frames):
        lagged = padded[n_frames - 1 - lag :][:n_steps]
        frames.append(jnp.where((age >= lag)[..., None], lagged, frames[-1]))
    return jnp.stack(frames[::-1], axis=-2)
