"""Reset and step of one environment as functions of flat arrays, each compiled as one kernel.

A step of one environment is a hundred kernels of under a microsecond. XLA's CPU runtime takes longer to hand each to
its thread pool than the work takes, so the whole step is compiled as one kernel.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from subterra_jax.adapters import packing
from subterra_jax.adapters.choosing import reset_chosen
from subterra_jax.adapters.packing import Report, pack, take_key, unpacker
from subterra_jax.compiled import hashable
from subterra_jax.rules import Choice
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv

_MARK = {"xla_cpu_small_call": "true", "inlineable": "false"}
# From a function of params and arrays, the params, and arrays like the others, to a compiled function of the arrays.
Compile = Callable[..., Callable[..., Any]]


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
    with jax.default_device(first_cpu()):
        try:
            from jax.experimental.xla_metadata import set_xla_metadata

            return jax.jit(lambda *args: set_xla_metadata(inner(*args), **_MARK)).lower(*examples).compile()
        except (ImportError, TypeError, jax.errors.JaxRuntimeError):
            return inner.lower(*examples).compile()


def compile_with_params(function: Callable[..., Any], params: EnvParams, *examples: Any) -> Callable[..., Any]:
    """Compile a function as one kernel in which the params are constants."""
    return compile_as_one_kernel(functools.partial(function, params), *examples)


def first_cpu() -> jax.Device:
    """Return the device of single environments."""
    return jax.local_devices(backend="cpu")[0]


class Programs(NamedTuple):
    """Compiled reset and step, which take and return flat arrays."""

    reset: Callable[..., Any]  # from a stream to the stream with the state, and the observation
    # compiles, at its first call, and returns the program of a reset to a chosen place
    begin: Callable[[], Callable[..., Any]]
    step: Callable[..., Any]  # from stream with state, and action, to stream with state, and report
    read: Callable[[np.ndarray], Report]  # from a report's words to a report


@dataclasses.dataclass(frozen=True)
class _Setting:
    """An environment and its params, equal for equal ones by the digest of the params; shapes as for `programs_of`."""

    env: TunnelEnv
    digest: str
    compile: Compile
    params: EnvParams = dataclasses.field(compare=False)
    shapes: tuple[State, Report] = dataclasses.field(compare=False)


def programs_of(env: TunnelEnv, params: EnvParams, shapes: tuple[Any, Report], compile: Compile) -> Programs:
    """Return the programs of an environment; a second one with the same params takes those of the first.

    Args:
        env: The environment.
        params: Its params.
        shapes: Shapes and dtypes of a state and of a report.
        compile: As `compile_with_params`.
    """
    leaves, structure = jax.tree.flatten(jax.device_get(params))
    parts = [str(structure).encode(), *(f"{leaf.dtype}{leaf.shape}".encode() + leaf.tobytes() for leaf in leaves)]
    setting = _Setting(env, hashlib.sha256(b"|".join(parts)).hexdigest(), compile, params, shapes)
    return (_compile_programs if hashable(env) else _compile_programs.__wrapped__)(setting)


@functools.lru_cache(maxsize=16)
def _compile_programs(setting: _Setting) -> Programs:
    env, (state, report) = setting.env, setting.shapes
    stream, number = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.float32)
    packed, unpack = jax.eval_shape(pack, (stream, state)), unpacker((stream, state))

    def reset(params: EnvParams, stream: jax.Array) -> tuple[jax.Array, jax.Array]:
        key, stream = take_key(stream)
        obs, state = env.reset(key, params)
        return pack((stream, state)), obs

    def step(params: EnvParams, packed: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        stream, state = unpack(packed)
        key, stream = take_key(stream)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action, params)
        return pack((stream, state)), pack(Report(obs, reward, terminated, truncated, info))

    def begin(params: EnvParams, stream: jax.Array, choice: Choice) -> tuple[jax.Array, jax.Array, jax.Array]:
        key, stream = take_key(stream)
        obs, state, clear = reset_chosen(env, key, params, choice)
        return pack((stream, state)), obs, clear

    action = jax.ShapeDtypeStruct(env.action_space(setting.params).shape, np.float32)
    return Programs(
        setting.compile(reset, setting.params, stream),
        functools.cache(lambda: setting.compile(begin, setting.params, stream, Choice(*[number] * 4))),
        setting.compile(step, setting.params, packed, action),
        packing.python_reader(report),
    )
