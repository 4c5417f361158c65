"""Results of one iteration: the episodes that ended in it, made small on the device and fetched by the host."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

# One step in so many ends an episode, at most, or all of them are fetched.
_STEPS_PER_EPISODE = 64
FIELDS = ("coverage", "success", "contact", "episode_return", "length")


@struct.dataclass
class Finished:
    """The episodes that ended during an unroll, in place: read a field only where `done`."""

    done: Bool[Array, "time env"]  # the step was its episode's last
    coverage: Float[Array, "time env"]  # fraction of the tunnel covered, 0 to 1
    success: Bool[Array, "time env"]  # the task's goal was met
    contact: Bool[Array, "time env"]  # the episode ended at a wall or an obstacle
    episode_return: Float[Array, "time env"]  # undiscounted reward of the episode
    length: Int[Array, "time env"]  # steps of the episode


@struct.dataclass
class Ended:
    """Episodes as rows, by step and then by environment."""

    count: Any  # number of episodes; may exceed the room for rows
    index: Any  # Of their last step in the flattened unroll, `(room,)`; rows from `count` on hold nothing
    coverage: Any  # as in `Finished`, and so on
    success: Any  # likewise
    contact: Any  # likewise
    episode_return: Any  # likewise
    length: Any  # likewise


@struct.dataclass
class Report:
    """News of one iteration for the host."""

    # `Finished`: episodes that ended; it stays on the device but for the rare iteration in which more have ended
    # than `ended` has room for
    finished: Any
    ended: Any  # `Ended`: the same, small
    metrics: Any  # scalars by name
    policy: Any  # the policy that drove, before it learnt from this iteration


def report(finished: Finished, metrics: dict[str, Float[Array, ""]], policy: Any) -> Report:
    """Makes a report, its small part included."""
    return Report(finished, in_a_row(finished), metrics, policy)


def in_a_row(finished: Finished) -> Ended:
    """Packs finished episodes into rows, on the device; those without room are left out."""
    size = finished.done.size
    room = min(size, max(256, size // _STEPS_PER_EPISODE))
    # By bisection, since a scatter in a fixed order is slow on a GPU.
    so_far = jnp.cumsum(finished.done.reshape(-1), dtype=jnp.int32)
    index = jnp.minimum(jnp.searchsorted(so_far, 1 + jnp.arange(room, dtype=jnp.int32)), size - 1)
    rows = {name: getattr(finished, name).reshape(-1)[index] for name in FIELDS}
    return Ended(count=so_far[-1], index=index, **rows)


Fetched = tuple[Ended, dict[str, np.ndarray]]


def fetch(given: Report, n: int | None = None) -> list[Fetched]:
    """Fetches the ended episodes, cut to their count, and the metrics, in one transfer.

    Args:
        given: One report, or several stacked along the first axis.
        n: Number of reports in the stack; None is one that is not stacked.

    Returns:
        Episodes and metrics of each report.
    """
    ended, metrics = jax.device_get((given.ended, given.metrics))
    shape = given.finished.done.shape
    if n is None:
        return [(_cut(ended, shape, lambda: given.finished), metrics)]

    def one(k: int) -> Fetched:
        mine, scalars = jax.tree.map(lambda x: x[k], (ended, metrics))
        return _cut(mine, shape[1:], lambda: jax.tree.map(lambda x: x[k], given.finished)), scalars

    return [one(k) for k in range(n)]


def _cut(ended: Ended, shape: tuple[int, ...], finished: Callable[[], Finished]) -> Ended:
    """Returns the rows of all parts that hold an episode; from `finished` where rows had no room."""
    if np.any(ended.count > ended.index.shape[-1]):
        return _of_all(_whole(finished()))
    if np.ndim(ended.count) == 0:
        return jax.tree.map(lambda x: x[: int(ended.count)] if np.ndim(x) else x, ended)
    return _in_order(ended, shape[-1])


def _whole(finished: Finished) -> Finished:
    """Fetches finished episodes, with all parts beside each other as one batch of environments."""
    arrays = jax.device_get(finished)
    return jax.tree.map(lambda x: np.moveaxis(x, 0, 1).reshape(x.shape[1], -1) if x.ndim == 3 else x, arrays)


def _of_all(whole: Finished) -> Ended:
    (index,) = np.nonzero(whole.done.reshape(-1))
    return Ended(count=len(index), index=index, **{name: getattr(whole, name).reshape(-1)[index] for name in FIELDS})


def _in_order(ended: Ended, part_envs: int) -> Ended:
    """Sorts rows `(part, room)` into one: by step, then by environment, those of the first part first."""
    n_parts, room = ended.index.shape
    part, row = np.nonzero(np.arange(room) < ended.count[:, None])
    local = ended.index[part, row]
    index = local // part_envs * part_envs * n_parts + part * part_envs + local % part_envs
    order = np.argsort(index)
    rows = {name: getattr(ended, name)[part, row][order] for name in FIELDS}
    return Ended(count=len(index), index=index[order], **rows)
