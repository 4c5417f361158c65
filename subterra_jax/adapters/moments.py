"""Moments of a Gymnasium environment, to go back to; and forks, which JAX does not survive."""

import os
from typing import NamedTuple

import numpy as np

from subterra_jax.host.errors import SubterraError


class MomentError(SubterraError, ValueError):
    """A moment belongs to another environment."""


class ForkError(SubterraError, RuntimeError):
    """JAX was used before this process was forked."""


class Moment(NamedTuple):
    """All that changes in one environment, or in a batch of them, as NumPy arrays; it may be pickled.

    Attributes:
        task: Id of the task.
        words: Streams of keys and states, their bits as uint32, `(n_words,)` or `(n, n_words)`.
        obs: Last observations, `(n_obs,)` or `(n, n_obs)`.
        pending: Environments of a batch whose episode is over, `(n,)`; `None` for a single one.
    """

    task: str
    words: np.ndarray
    obs: np.ndarray
    pending: np.ndarray | None = None


def check_moment(moment: Moment, task: str, words: tuple[int, ...], obs: tuple[int, ...]) -> None:
    """Refuse what is no moment, a moment of another task, and one of another number of environments.

    Raises:
        MomentError: Naming what was given and what is wanted.
    """
    if not isinstance(moment, Moment):
        raise MomentError(f"set_state takes what get_state returned, got {type(moment).__name__}")
    if moment.task != task:
        raise MomentError(f"a moment of {moment.task} cannot be set in {task}")
    if (moment.words.shape, moment.obs.shape) != (words, obs):
        raise MomentError(f"a moment of shape {moment.words.shape} cannot be set in an environment of {words}")


_first_process: int | None = None


def refuse_fork() -> None:
    """Remember the first process that asks, and refuse its forks: their JAX would wait for ever.

    Raises:
        ForkError: This process was forked from one that has used JAX.
    """
    global _first_process
    if _first_process is None:
        _first_process = os.getpid()
    if _first_process != os.getpid():
        raise ForkError(
            "JAX does not survive a fork: let the processes be spawned, with context='spawn' in "
            "gymnasium.vector.AsyncVectorEnv, or take vectorization_mode='vector_entry_point', which needs none"
        )
