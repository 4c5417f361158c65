"""What one iteration tells the host: the episodes that ended in it, by a small transfer, and scalars by name."""

from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

# One step in so many ends an episode, at most, or all of them are fetched.
_STEPS_PER_EPISODE = 64
FIELDS = ("coverage", "success", "contact", "episode_return", "length")


@struct.dataclass
class Finished:
    """The episodes that ended during an unroll, in place: read a field only where `done`.

    Attributes:
        done: Whether the step was its episode's last.
        coverage: Share of the tunnel covered, 0 to 1.
        success: Whether the task's goal was met.
        contact: Whether the episode ended at a wall or an obstacle.
        episode_return: Undiscounted reward of the episode.
        length: Steps of the episode.
    """

    done: Bool[Array, "time env"]
    coverage: Float[Array, "time env"]
    success: Bool[Array, "time env"]
    contact: Bool[Array, "time env"]
    episode_return: Float[Array, "time env"]
    length: Int[Array, "time env"]


@struct.dataclass
class Ended:
    """The same episodes in a row, by step and then by environment.

    Attributes:
        count: How many there are, which may be more than there is room for.
        index: Of their last step in the flattened unroll, `(room,)`; rows from `count` on hold nothing.
        coverage: As in `Finished`, and so on.
        success: Likewise.
        contact: Likewise.
        episode_return: Likewise.
        length: Likewise.
    """

    count: Any
    index: Any
    coverage: Any
    success: Any
    contact: Any
    episode_return: Any
    length: Any


@struct.dataclass
class Report:
    """What the host wants to know of one iteration.

    Attributes:
        finished: `Finished`: episodes that ended; it stays on the device but for the rare iteration in which more have
            ended than `ended` has room for.
        ended: `Ended`: the same, small.
        metrics: Scalars by name.
        policy: The policy that drove, before it learnt from this iteration.
    """

    finished: Any
    ended: Any
    metrics: Any
    policy: Any


def report(finished: Finished, metrics: dict[str, Float[Array, ""]], policy: Any) -> Report:
    """A report with its small part made."""
    return Report(finished, in_a_row(finished), metrics, policy)


def in_a_row(finished: Finished) -> Ended:
    """Finished episodes as rows, on the device; what there is no room for is left out."""
    size = finished.done.size
    room = min(size, max(256, size // _STEPS_PER_EPISODE))
    # By bisection, since a scatter in a fixed order is slow on a GPU.
    so_far = jnp.cumsum(finished.done.reshape(-1), dtype=jnp.int32)
    index = jnp.minimum(jnp.searchsorted(so_far, 1 + jnp.arange(room, dtype=jnp.int32)), size - 1)
    rows = {name: getattr(finished, name).reshape(-1)[index] for name in FIELDS}
    return Ended(count=so_far[-1], index=index, **rows)
