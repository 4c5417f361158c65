"""Gymnasium, one environment: no GL, no GPU, a step in some 50 µs of one core.

A step of one environment is a hundred kernels of under a microsecond. XLA's CPU runtime takes longer to hand each to
its thread pool than the work takes, so the whole step is compiled as one kernel.
"""

import copy
import dataclasses
import functools
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from gymnasium import error
from gymnasium.core import Env

from subterra_jax.adapters import packing
from subterra_jax.adapters.choosing import check_clear, read_choice, reset_chosen
from subterra_jax.adapters.moments import Moment, check_moment, refuse_fork
from subterra_jax.adapters.packing import Observation, as_observation, pack, start_streams, take_key, unpacker
from subterra_jax.adapters.views import view_for
from subterra_jax.compiled import hashable
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.rules import Choice
from subterra_jax.state import EnvParams, State
from subterra_jax.tasks import make
from subterra_jax.tunnel.sources import Source
from subterra_jax.tunnel_env import TunnelEnv

_COMPILED = ("_reset", "_begin", "_step", "_unpack", "_read")  # made by `_compile`, not to be pickled
_SHARED = (*_COMPILED, "_env", "_params", "_packed", "spec")  # never changed in place
_MARK = {"xla_cpu_small_call": "true", "inlineable": "false"}


def compile_as_one_kernel(function: Callable[..., Any], *examples: Any) -> Callable[..., Any]:
    """Compile a small function ahead of time as one kernel for the first CPU, whatever the default device.

    Args:
        function: Pure function of arrays that returns a pytree of arrays.
        *examples: Arrays, or shapes and dtypes, like its arguments.

    Returns:
        The compiled function, which takes only such arguments. Operations that cannot be part of one kernel, such as a
        sort, are compiled in the usual way, along with all others.

    Source: XLA, `ThunkEmitter::EmitCallThunk` and `SmallWhileLoopHoistingPass`. An XLA that does not know the mark
    ignores it, and the program runs as it would have without.
    """
    inner = jax.jit(function)
    with jax.default_device(_first_cpu()):
        try:
            from jax.experimental.xla_metadata import set_xla_metadata

            return jax.jit(lambda *args: set_xla_metadata(inner(*args), **_MARK)).lower(*examples).compile()
        except (ImportError, TypeError, jax.errors.JaxRuntimeError):
            return inner.lower(*examples).compile()


def _first_cpu() -> jax.Device:
    return jax.local_devices(backend="cpu")[0]


@dataclasses.dataclass(frozen=True)
class _Setting:
    """An environment and its params; equal for equal ones.

    Attributes:
        env: The environment.
        digest: Digest of the params.
        params: The params.
    """

    env: TunnelEnv
    digest: str
    params: EnvParams = dataclasses.field(compare=False)


class _Programs(NamedTuple):
    """Compiled reset and step, which take and return flat arrays, and the readers of those.

    Attributes:
        reset: From a stream to the stream with the state, and the observation.
        begin: Compiles, at its first call, and returns the program of a reset to a chosen place.
        step: From stream with state, and action, to stream with state, and report.
        unpack: From stream with state to the two.
        read: From a report's words to a report.
        n_words: Shape of stream with state.
    """

    reset: Callable[..., Any]
    begin: Callable[[], Callable[..., Any]]
    step: Callable[..., Any]
    unpack: Callable[[Any], Any]
    read: Callable[[np.ndarray], packing.Report]
    n_words: tuple[int, ...]


def _programs_of(env: TunnelEnv, params: EnvParams) -> _Programs:
    """Return the programs of an environment; a second one with the same params takes those of the first."""
    leaves, structure = jax.tree.flatten(jax.device_get(params))
    parts = [str(structure).encode(), *(f"{leaf.dtype}{leaf.shape}".encode() + leaf.tobytes() for leaf in leaves)]
    setting = _Setting(env, hashlib.sha256(b"|".join(parts)).hexdigest(), params)
    return (_compile_programs if hashable(env) else _compile_programs.__wrapped__)(setting)


@functools.lru_cache(maxsize=16)
def _compile_programs(setting: _Setting) -> _Programs:
    """Compile reset and step as functions of two flat arrays: the stream with the state, and the action."""
    env, params = setting.env, setting.params
    # On the device they are compiled for, or JAX would trace reset and step anew for it.
    with jax.default_device(_first_cpu()):
        state, example = packing.report_shapes(env, params)
    stream = jax.ShapeDtypeStruct((2,), np.uint32)
    packed = jax.eval_shape(pack, (stream, state))
    unpack = unpacker((stream, state))

    def reset(stream: jax.Array) -> tuple[jax.Array, jax.Array]:
        key, stream = take_key(stream)
        obs, state = env.reset(key, params)
        return pack((stream, state)), obs

    def step(packed: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        stream, state = unpack(packed)
        key, stream = take_key(stream)
        words, state = packing.step_and_pack(env, key, state, action, params)
        return pack((stream, state)), words

    def begin(stream: jax.Array, choice: Choice) -> tuple[jax.Array, jax.Array, jax.Array]:
        key, stream = take_key(stream)
        obs, state, clear = reset_chosen(env, key, params, choice)
        return pack((stream, state)), obs, clear

    number = jax.ShapeDtypeStruct((), np.float32)
    return _Programs(
        compile_as_one_kernel(reset, stream),
        functools.cache(lambda: compile_as_one_kernel(begin, stream, Choice(*[number] * 4))),
        compile_as_one_kernel(step, packed, jax.ShapeDtypeStruct((env.action_size,), np.float32)),
        unpack,
        packing.python_reader(example),
        packed.shape,
    )


class SubterraEnv(Env[Observation, np.ndarray]):
    """One environment as a `gymnasium.Env`; `info` holds Python floats, ints and bools.

    The observation is a plain vector for the paper's task, and a dict of named parts for a task that adds to it.

    Args:
        task: Id of the task.
        tunnel: As for `subterra_jax.make`. `None` is the scene's tunnel if a scene is given.
        lining: As for `subterra_jax.make`.
        flat: Return a plain vector for every task.
        render_mode: `None` or `rgb_array`.
        view: Picture of `render`: `top`, the plan from above, drawn without GL; or `mujoco`, from a camera behind the
            robot: the scene, or without one the bore of the tunnel.
        scene: Folder of `scene.build`, or one of its MJCF files.
        split: As for `subterra_jax.make`.
        **overrides: As for `subterra_jax.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = "Subterra/Traverse-v1",
        tunnel: Source | Sequence[Source] = None,
        lining: str | None = None,
        flat: bool = False,
        render_mode: str | None = None,
        view: str = "top",
        scene: str | Path | None = None,
        split: str | None = None,
        **overrides: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        refuse_fork()
        self.render_mode = render_mode
        self._view, tunnel = view_for(view, scene, task, tunnel, split, lining, overrides.get("sensor", SENSORS[0]))
        env, params = make(task, tunnel, lining, **overrides)
        self._env, self._params = env, params
        self._fields = packing.named_fields(env, params, flat)
        self.observation_space = packing.observation_space(env, params, self._fields)
        self.action_space = packing.action_space(env, params)
        self._packed: Any = None
        self._obs = np.zeros(env.observation_size(params), np.float32)
        self._compile()

    def _compile(self) -> None:
        """Take the programs of the environment and its params."""
        programs = _programs_of(self._env, self._params)
        self._reset, self._begin, self._step, self._unpack, self._read, self._n_words = programs

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; the same seed begins the same sequence of episodes.

        Args:
            seed: Seed of the sequence; `None` goes on with it.
            options: `goal`: station of the goal, m. `start`: station of the start, m, or a mapping with `station` (m),
                `lateral` (m to the left of the centreline) and `heading` (rad against the centreline; π faces the
                mouth). What is left out is drawn as ever. A task that observes its start observes the chosen one, as it
                is; in the others no observation holds it.

        Raises:
            OptionError: The task has no such thing, or the robot cannot stand there.
        """
        refuse_fork()
        choice = read_choice(self._env, self._params, options)
        super().reset(seed=seed)
        if seed is not None or self._packed is None:
            stream = start_streams([seed], self.np_random)[0]
        else:
            stream = np.asarray(self._packed)[:2]
        if choice is None:
            packed, obs = self._reset(stream)
        else:
            packed, obs, clear = self._begin()(stream, choice)
            check_clear(clear, choice)
        self._packed, self._obs = packed, np.array(obs)
        return as_observation(self._obs, self._fields), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one step of 0.1 s; the action is clipped to its space, a NaN counts as 0."""
        if self._packed is None:
            raise error.ResetNeeded("reset() must come before step()")
        action = np.asarray(action, np.float32)
        if action.shape != (self._env.action_size,):
            raise ValueError(f"an action must have shape {(self._env.action_size,)}, got {action.shape}")
        self._packed, words = self._step(self._packed, action)
        self._obs, reward, terminated, truncated, info = self._read(np.array(words))
        return as_observation(self._obs, self._fields), reward, terminated, truncated, info

    @property
    def task_env(self) -> TunnelEnv:
        """The JAX environment."""
        return self._env

    @property
    def task_params(self) -> EnvParams:
        """Its params."""
        return self._params

    @property
    def state(self) -> State | None:
        """Present state, on the host; `None` before the first reset."""
        return None if self._packed is None else self._unpack(np.asarray(self._packed))[1]

    def get_state(self) -> Moment:
        """Return all that changes, to be set again later: in this environment, a copy or another process."""
        if self._packed is None:
            raise error.ResetNeeded("reset() must come before get_state()")
        return Moment(self._env.id, np.array(self._packed), self._obs.copy())

    def set_state(self, moment: Moment) -> Observation:
        """Go back to a moment; what follows has the same bits as it had then.

        Returns:
            The observation of that moment.

        Raises:
            MomentError: It belongs to another task.
        """
        check_moment(moment, self._env.id, self._n_words, self._obs.shape)
        self._packed, self._obs = moment.words.copy(), moment.obs.copy()
        return as_observation(self._obs, self._fields)

    def __copy__(self) -> "SubterraEnv":
        """Share what is compiled and what does not change."""
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__)
        return twin

    def __deepcopy__(self, memo: dict[int, Any]) -> "SubterraEnv":
        """Share what is compiled and copy what changes; the renderer is made anew."""
        twin = copy.copy(self)
        memo[id(self)] = twin
        changing = {name: value for name, value in self.__dict__.items() if name not in _SHARED}
        twin.__dict__.update(copy.deepcopy(changing, memo))
        return twin

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is compiled."""
        return {name: value for name, value in self.__dict__.items() if name not in _COMPILED} | {
            "_packed": None if self._packed is None else np.asarray(self._packed)
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Compile anew."""
        refuse_fork()
        self.__dict__.update(state)
        self._compile()

    def render(self) -> np.ndarray | None:
        """Return a picture of the last step, `(480, 480, 3)` uint8; `None` without `rgb_array`."""
        if self.render_mode is None:
            return None
        if (state := self.state) is None:
            raise error.ResetNeeded("reset() must come before render()")
        return self._view.picture(self._env, self._params, state, self._obs)

    def close(self) -> None:
        """Release the renderer, if there is one."""
        self._view.close()
