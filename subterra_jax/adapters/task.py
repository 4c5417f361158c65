"""Base of Gymnasium's single environment and of its batch: a made task and its pictures."""

import functools
import os
from typing import Any

import jax
import numpy as np
from gymnasium import error, spaces

from subterra_jax.adapters.kernel import (
    Compile,
    Fields,
    Programs,
    Report,
    as_observation,
    compile_with_params,
    first_cpu,
    programs_of,
    unpacker,
)
from subterra_jax.env import Box
from subterra_jax.host.errors import SubterraError
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.pictures.views import View, view_for
from subterra_jax.state import EnvParams
from subterra_jax.tasks import make
from subterra_jax.tunnel_env import TunnelEnv

PAPER_FIELDS = ("ranges", "odometry")  # of the paper's task, whose observation is a plain vector


class ForkError(SubterraError, RuntimeError):
    """JAX was used before this process was forked."""


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
        flat: Return a plain vector for every task; a task with `PAPER_FIELDS` alone does so anyway.
        compile: Compiles reset and step of a single environment.

    Attributes:
        fields: Parts of an observation by name; `None` for a plain vector.
        observation_space: A `Box`, or a `Dict` with one `Box` for each part; that of an image has rows and columns.
        action_space: Bounds of an action.
        state: Shapes and dtypes of a state.
        report: Shapes and dtypes of a step's report.
        unpack: From words to a stream and a state, see `packing.unpacker`.
        read: From the words of reports to reports.
    """

    def __init__(
        self, env: TunnelEnv, params: EnvParams, flat: bool = False, compile: Compile = compile_with_params
    ) -> None:
        refuse_fork()
        self.env, self.params, self._compile = env, params, compile
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

    @functools.cached_property
    def programs(self) -> Programs:
        """Reset and step of a single environment, compiled at their first use."""
        return programs_of(self.env, self.params, (self.state, self.report), self._compile)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Task":
        return self


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


def open_task(task: str, flat: bool, render_mode: str | None, view: str, options: dict[str, Any]) -> tuple[Task, View]:
    """Make a task and the view of its pictures; arguments as for `SubterraEnv`.

    Raises:
        ValueError: There is no such mode or view.
        ForkError: See `refuse_fork`.
        SubterraError: As for `subterra_jax.make`.
    """
    check_mode(render_mode)
    refuse_fork()
    tunnel, lining, split = (options.pop(name, None) for name in ("tunnel", "lining", "split"))
    scene = options.get("scene")  # which takes the place of a tunnel, in the picture too
    drawn, found = view_for(
        view, task, scene or tunnel, split, lining, options.get("sensor", SENSORS[0]), options.get("texture", 0.0)
    )
    tunnel = tunnel if scene else found
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

    @property
    def task_env(self) -> TunnelEnv:
        return self.task.env

    @property
    def task_params(self) -> EnvParams:
        return self.task.params

    def _last(self, asked: str) -> np.ndarray:
        """Return the last observations.

        Raises:
            ResetNeeded: There are none yet.
        """
        if self._obs is None:
            raise error.ResetNeeded(f"reset() must come before {asked}()")
        return self._obs
