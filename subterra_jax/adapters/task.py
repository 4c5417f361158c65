"""Base of Gymnasium's single environment and of its batch: a made task, its moments and its pictures."""

import functools
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from gymnasium import error, spaces

from subterra_jax.adapters.kernel import Compile, Programs, compile_with_params, first_cpu, programs_of
from subterra_jax.adapters.packing import Fields, Observation, Report, as_observation, unpacker
from subterra_jax.env import Box
from subterra_jax.host.errors import SubterraError
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.pictures.views import View, view_for
from subterra_jax.state import EnvParams
from subterra_jax.tasks import make
from subterra_jax.tunnel_env import TunnelEnv

PAPER_FIELDS = ("ranges", "odometry")  # of the paper's task, whose observation is a plain vector


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


_first_process: int | None = None


def refuse_fork() -> None:
    """Remember the first process that asks, and refuse its forks: their JAX would wait for ever.

    Raises:
        ForkError: This process was forked from one that has used JAX.
    """
    global _first_process
    _first_process = _first_process or os.getpid()
    if _first_process != os.getpid():
        raise ForkError(
            "JAX does not survive a fork: let the processes be spawned, with context='spawn' in "
            "gymnasium.vector.AsyncVectorEnv, or take vectorization_mode='vector_entry_point', which needs none"
        )


class Task:
    """An environment, its params and what follows from them. Nothing in it changes, so that copies share it.

    Args:
        env: The environment.
        params: Its params.
        flat: Return a plain vector for every task; a task with `PAPER_FIELDS` alone does so anyway.
        compile: Compiles reset and step of a single environment.

    Attributes:
        fields: Parts of an observation by name; `None` for a plain vector.
        observation_space: A `Box`, or a `Dict` with one `Box` for each part; that of an image has rows and columns.
        action_space: Bounds of an action.
        state: Shapes and dtypes of a state.
        report: Shapes and dtypes of a step's report.
        unpack: From words to a stream and a state, see `packing.unpacker`.
        n_words: Number of those words.
        read: From the words of reports to reports.
    """

    def __init__(
        self, env: TunnelEnv, params: EnvParams, flat: bool = False, compile: Compile = compile_with_params
    ) -> None:
        refuse_fork()
        self.env, self.params, self.flat, self.compile = env, params, flat, compile
        self.fields = _named_fields(env, params, flat)
        self.observation_space = _observation_space(env.observation_space(params), self.fields)
        bounds = env.action_space(params)
        self.action_space = spaces.Box(bounds.low, bounds.high, dtype=np.float32)
        key, action = jax.eval_shape(jax.random.key, 0), jax.ShapeDtypeStruct(bounds.shape, np.float32)
        # On the device that single steps are compiled for, or JAX would trace reset and step anew for it.
        with jax.default_device(first_cpu()):
            _, self.state = jax.eval_shape(env.reset, key, params)
            obs, _, *rest = jax.eval_shape(env.step, key, self.state, action, params)
        self.report = Report(obs, *rest)
        packed = jax.ShapeDtypeStruct((2,), np.uint32), self.state
        self.unpack, self.read = unpacker(packed), unpacker(self.report)
        self.n_words = sum(leaf.size for leaf in jax.tree.leaves(packed))

    @functools.cached_property
    def programs(self) -> Programs:
        """Reset and step of a single environment, compiled at their first use."""
        return programs_of(self.env, self.params, (self.state, self.report), self.compile)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Task":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Task, (self.env, self.params, self.flat, self.compile)


def _named_fields(env: TunnelEnv, params: EnvParams, flat: bool) -> Fields | None:
    if flat or tuple(fields := env.fields(params)) == PAPER_FIELDS:
        return None
    images = env.images(params)
    return {name: (at, images.get(name, (at.stop - at.start,))) for name, at in fields.items()}


def _observation_space(box: Box, fields: Fields | None) -> spaces.Space[Any]:
    if fields is None:
        return spaces.Box(box.low, box.high, dtype=np.float32)
    # Gymnasium would sort the keys of a plain dict; this order is that of the vector.
    low, high = (as_observation(side, fields) for side in (box.low, box.high))
    return spaces.Dict([(name, spaces.Box(low[name], high[name], dtype=np.float32)) for name in fields])


def open_task(
    task: str, flat: bool, render_mode: str | None, view: str, scene: str | Path | None, options: dict[str, Any]
) -> tuple[Task, View]:
    """Make a task and the view of its pictures; arguments as for `SubterraEnv`.

    Raises:
        ValueError: There is no such mode or view.
        ForkError: See `refuse_fork`.
        SubterraError: As for `subterra_jax.make`.
    """
    check_mode(render_mode)
    refuse_fork()
    tunnel, lining, split = (options.pop(name, None) for name in ("tunnel", "lining", "split"))
    drawn, tunnel = view_for(view, scene, task, tunnel, split, lining, options.get("sensor", SENSORS[0]))
    return Task(*make(task, tunnel, lining, **options), flat), drawn


def check_mode(render_mode: str | None) -> None:
    """Refuse a mode of rendering other than `None` and `rgb_array`."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")


class Door:
    """A task behind Gymnasium's methods; the base of `SubterraEnv` and `SubterraVectorEnv`."""

    task: Task  # the task
    view: View  # what draws its pictures
    _obs: np.ndarray | None = None  # last observations; `None` before the first reset
    _pending: Any = None  # environments of a batch whose episode is over, `(n,)`

    @property
    def task_env(self) -> TunnelEnv:
        return self.task.env

    @property
    def task_params(self) -> EnvParams:
        return self.task.params

    def get_state(self) -> Moment:
        """Return all that changes, to be set again later: in this environment, a copy or another process."""
        obs = self._last("get_state")
        pending = None if self._pending is None else self._pending.copy()
        return Moment(self.task.env.id, self._words(), obs.copy(), pending)

    def set_state(self, moment: Moment) -> Observation:
        """Go back to a moment; what follows has the same bits as it had then.

        Returns:
            The observation of that moment.

        Raises:
            MomentError: It belongs to another task, or to another number of environments.
        """
        if not isinstance(moment, Moment):
            raise MomentError(f"set_state takes what get_state returned, got {type(moment).__name__}")
        if moment.task != self.task.env.id:
            raise MomentError(f"a moment of {moment.task} cannot be set in {self.task.env.id}")
        batch = () if self._pending is None else self._pending.shape
        wanted = (*batch, self.task.n_words), (*batch, *self.task.report.obs.shape)
        if (moment.words.shape, moment.obs.shape) != wanted:
            raise MomentError(f"a moment of shape {moment.words.shape} cannot be set in an environment of {wanted[0]}")
        self._put(moment.words.copy(), moment.obs.copy())
        self._obs = moment.obs.copy()
        self._pending = None if moment.pending is None else moment.pending.copy()
        return as_observation(self._obs, self.task.fields)

    def _last(self, asked: str) -> np.ndarray:
        """Return the last observations.

        Raises:
            ResetNeeded: There are none yet.
        """
        if self._obs is None:
            raise error.ResetNeeded(f"reset() must come before {asked}()")
        return self._obs

    def _words(self) -> np.ndarray:
        raise NotImplementedError

    def _put(self, words: np.ndarray, obs: np.ndarray) -> None:
        raise NotImplementedError
