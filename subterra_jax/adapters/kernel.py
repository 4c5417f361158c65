"""Reset and step of one environment as functions of flat arrays, each compiled as one kernel; streams of keys.

Passing many small arrays between host and device would cost more than a step itself, so a pytree travels as one array.
A step of one environment is a hundred kernels of under a microsecond. XLA's CPU runtime takes longer to hand each to
its thread pool than the work takes, so the whole step is compiled as one kernel.
"""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, UInt32

from subterra_jax.compiled import hashable
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv

_WORD = 0xFFFFFFFF
Fields = dict[str, tuple[slice, tuple[int, ...]]]  # place in the vector, and shape, of each part of an observation
Observation = np.ndarray | dict[str, np.ndarray]


def pack(tree: Any) -> UInt32[Array, "n_words"]:
    """Join the leaves of a pytree into one array of words, their bits unchanged, a bool as 0 or 1."""

    def words(leaf: Array) -> Array:
        _check_kind(leaf.dtype)
        return leaf.astype(jnp.uint32) if leaf.dtype == jnp.bool_ else jax.lax.bitcast_convert_type(leaf, jnp.uint32)

    return jnp.concatenate([words(jnp.asarray(leaf)).reshape(-1) for leaf in jax.tree.leaves(tree)])


def unpacker(example: Any) -> Callable[[Any], Any]:
    """Return the inverse of `pack`.

    Args:
        example: A pytree of arrays, or of shapes and dtypes, like those that were packed.

    Returns:
        Words `(..., n_words)` to a pytree whose leaves have those leading axes; of JAX arrays inside a graph, of NumPy
        arrays outside.

    Raises:
        TypeError: A leaf is neither bool nor 32 bits wide.
    """
    leaves, structure = jax.tree.flatten(example)
    kinds = [_check_kind(np.dtype(leaf.dtype)) for leaf in leaves]
    shapes = [tuple(leaf.shape) for leaf in leaves]
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()

    def values(words: Any, kind: np.dtype) -> Any:
        if kind == np.bool_:
            return words != 0
        return words.view(kind) if isinstance(words, np.ndarray) else jax.lax.bitcast_convert_type(words, kind)

    def unpack(words: Any) -> Any:
        parts = [words[..., start:end] for start, end in zip([0, *ends], ends, strict=False)]
        made = zip(parts, kinds, shapes, strict=True)
        leaves = [values(part, kind).reshape((*part.shape[:-1], *shape)) for part, kind, shape in made]
        return jax.tree.unflatten(structure, leaves)

    return unpack


def _check_kind(kind: np.dtype) -> np.dtype:
    if kind != np.bool_ and kind.itemsize != 4:
        raise TypeError(f"only bools and 32-bit numbers can be packed, got {kind}")
    return kind


def start_streams(seeds: Sequence[int | None], fallback: np.random.Generator) -> UInt32[np.ndarray, "n 2"]:
    """Begin streams at seeds.

    A stream is the two words of a Threefry key. Each reset and each step takes one key and leaves the next, so that an
    environment does the same alone and among others.

    Args:
        seeds: Seed of each stream, from 0 to 2⁶⁴ - 1; `None` draws one from `fallback`.
        fallback: Source of the seeds that are `None`.

    Raises:
        ValueError: A seed is out of range.
    """
    chosen = [int(fallback.integers(2**63)) if seed is None else int(seed) for seed in seeds]
    for seed in chosen:
        if not 0 <= seed < 2**64:
            raise ValueError(f"a seed must be from 0 to 2**64 - 1, got {seed}")
    return np.array([[seed >> 32, seed & _WORD] for seed in chosen], np.uint32).reshape(-1, 2)


def take_key(stream: UInt32[Array, "2"]) -> tuple[PRNGKeyArray, UInt32[Array, "2"]]:
    """Return the next key of a stream, and the stream after it."""
    now, rest = jax.random.split(jax.random.wrap_key_data(stream, impl="threefry2x32"))
    return now, jax.random.key_data(rest)


class Report(NamedTuple):
    """Result of one step, or of a batch of steps."""

    obs: Any  # observation, `(..., n_obs)`
    reward: Any  # reward, `(...)`
    terminated: Any  # whether the episode ended before the horizon, `(...)`
    truncated: Any  # whether it ended at the horizon, `(...)`
    info: dict[str, Any]  # the environment's own `info`


def python_reader(example: Report) -> Callable[[np.ndarray], Report]:
    """Return a reader of one step's words as Python's own floats, ints and bools; `example` as for `unpacker`."""
    unpack = unpacker(example)

    def read(words: np.ndarray) -> Report:
        obs, reward, terminated, truncated, info = unpack(words)
        plain = {name: values if values.ndim else values.item() for name, values in info.items()}
        return Report(obs, reward.item(), terminated.item(), truncated.item(), plain)

    return read


def as_observation(vector: np.ndarray, fields: Fields | None) -> Observation:
    """Bring vectors `(..., n_obs)` into the form of the space; the parts of a dict are views."""
    if fields is None:
        return vector
    return {name: vector[..., at].reshape(*vector.shape[:-1], *shape) for name, (at, shape) in fields.items()}


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
    stream = jax.ShapeDtypeStruct((2,), np.uint32)
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

    action = jax.ShapeDtypeStruct(env.action_space(setting.params).shape, np.float32)
    return Programs(
        setting.compile(reset, setting.params, stream),
        setting.compile(step, setting.params, packed, action),
        python_reader(report),
    )
