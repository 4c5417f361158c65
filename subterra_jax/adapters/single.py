"""Gymnasium, one environment: no GL, no GPU, a step in some 50 µs of one core.

A step of one environment is a hundred kernels of under a microsecond. XLA's CPU runtime takes longer to hand each to
its thread pool than the work takes, so the whole step is compiled as one kernel.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from gymnasium import error
from gymnasium.core import Env

from subterra_jax.adapters import packing
from subterra_jax.adapters.packing import Observation, as_observation, pack, start_streams, take_key, unpacker
from subterra_jax.adapters.views import make_view
from subterra_jax.tasks import make
from subterra_jax.tunnel.sources import Source

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
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        try:
            from jax.experimental.xla_metadata import set_xla_metadata

            return jax.jit(lambda *args: set_xla_metadata(inner(*args), **_MARK)).lower(*examples).compile()
        except (ImportError, TypeError, jax.errors.JaxRuntimeError):
            return inner.lower(*examples).compile()


class SubterraEnv(Env[Observation, np.ndarray]):
    """One environment as a `gymnasium.Env`; `info` holds Python floats, ints and bools.

    The observation is a plain vector for the paper's task, and a dict of named parts for a task that adds to it.

    Args:
        task: Id of the task.
        tunnel: As for `subterra_jax.make`. `None` is the scene's tunnel if a scene is given, else the packaged one.
        lining: As for `subterra_jax.make`.
        flat: Return a plain vector for every task.
        render_mode: `None` or `rgb_array`.
        view: Picture of `render`: `top`, the plan from above, drawn without GL; or `mujoco`, the scene from a camera
            behind the robot.
        scene: Folder of `scene.build`, or one of its MJCF files; `view="mujoco"` needs it, `top` does not.
        **overrides: As for `subterra_jax.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = "Subterra/Traverse-v0",
        tunnel: Source | Sequence[Source] = None,
        lining: str | None = None,
        flat: bool = False,
        render_mode: str | None = None,
        view: str = "top",
        scene: str | Path | None = None,
        **overrides: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
        self._view = make_view(view, scene)
        env, params = make(task, self._view.tunnel if tunnel is None else tunnel, lining, **overrides)
        self._env, self._params = env, params
        self._fields = packing.named_fields(env, params, flat)
        self.observation_space = packing.observation_space(env, params, self._fields)
        self.action_space = packing.action_space(env, params)
        self._stream: np.ndarray | None = None
        self._packed: Any = None
        self._compile()

    def _compile(self) -> None:
        """Compile reset and step as functions of two flat arrays: the stream with the state, and the action."""
        env, params = self._env, self._params
        state, example = packing.report_shapes(env, params)
        stream = jax.ShapeDtypeStruct((2,), np.uint32)
        packed = jax.eval_shape(pack, (stream, state))
        self._unpack, self._read = unpacker((stream, state)), packing.python_reader(example)
        unpack = self._unpack

        def reset(stream: jax.Array) -> tuple[jax.Array, jax.Array]:
            key, stream = take_key(stream)
            obs, state = env.reset(key, params)
            return pack((stream, state)), obs

        def step(packed: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
            stream, state = unpack(packed)
            key, stream = take_key(stream)
            words, state = packing.step_and_pack(env, key, state, action, params)
            return pack((stream, state)), words

        self._reset = compile_as_one_kernel(reset, stream)
        self._step = compile_as_one_kernel(step, packed, jax.ShapeDtypeStruct((env.action_size,), np.float32))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; the same seed begins the same sequence of episodes. There are no options."""
        super().reset(seed=seed)
        if seed is not None or self._packed is None:
            stream = start_streams([seed], self.np_random)[0]
        else:
            stream = np.asarray(self._packed)[:2]
        self._packed, obs = self._reset(stream)
        self._obs = np.array(obs)
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

    def render(self) -> np.ndarray | None:
        """Return a picture of the last step, `(480, 480, 3)` uint8; `None` without `rgb_array`."""
        if self.render_mode is None:
            return None
        if self._packed is None:
            raise error.ResetNeeded("reset() must come before render()")
        _, state = self._unpack(np.asarray(self._packed))
        return self._view.picture(self._env, self._params, state, self._obs)

    def close(self) -> None:
        """Release the renderer, if there is one."""
        self._view.close()
