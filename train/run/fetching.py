"""Ended episodes and metrics of an iteration, from the device to the host."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from train.run.report import FIELDS, Ended, Finished, Report

Told = tuple[Ended, dict[str, np.ndarray]]


def fetch(given: Report) -> Told:
    """Ended episodes, cut to their count, and metrics, on the host."""
    ended, metrics = jax.device_get((given.ended, given.metrics))
    return _cut(ended, given.finished.done.shape, lambda: given.finished), metrics


def fetch_all(given: Report, n: int) -> list[Told]:
    """As `fetch`, of `n` reports stacked along the first axis, in one transfer."""
    ended, metrics = jax.device_get((given.ended, given.metrics))
    shape = given.finished.done.shape[1:]
    return [_one(ended, metrics, shape, given.finished, k) for k in range(n)]


def _one(ended: Ended, metrics: dict[str, Any], shape: tuple[int, ...], finished: Finished, k: int) -> Told:
    mine, scalars = jax.tree.map(lambda x: x[k], (ended, metrics))
    return _cut(mine, shape, lambda: jax.tree.map(lambda x: x[k], finished)), scalars


def _cut(ended: Ended, shape: tuple[int, ...], finished: Callable[[], Finished]) -> Ended:
    """Rows of the episodes that there are, of all parts; from `finished` where they had no room."""
    if np.any(ended.count > ended.index.shape[-1]):
        return _of_all(_whole(finished()))
    if np.ndim(ended.count) == 0:
        return jax.tree.map(lambda x: x[: int(ended.count)] if np.ndim(x) else x, ended)
    return _in_order(ended, shape[-1])


def _whole(finished: Finished) -> Finished:
    """On the host, with all parts beside each other as one batch of environments."""
    alone = jax.process_count() == 1
    arrays = jax.device_get(finished) if alone else multihost_utils.process_allgather(finished, tiled=True)
    return jax.tree.map(lambda x: np.moveaxis(x, 0, 1).reshape(x.shape[1], -1) if x.ndim == 3 else x, arrays)


def _of_all(whole: Finished) -> Ended:
    (index,) = np.nonzero(whole.done.reshape(-1))
    return Ended(count=len(index), index=index, **{name: getattr(whole, name).reshape(-1)[index] for name in FIELDS})


def _in_order(ended: Ended, part_envs: int) -> Ended:
    """Rows `(part, room)` as one row: by step, then by environment, those of the first part first."""
    n_parts, room = ended.index.shape
    part, row = np.nonzero(np.arange(room) < ended.count[:, None])
    local = ended.index[part, row]
    index = local // part_envs * part_envs * n_parts + part * part_envs + local % part_envs
    order = np.argsort(index)
    rows = {name: getattr(ended, name)[part, row][order] for name in FIELDS}
    return Ended(count=len(index), index=index[order], **rows)
