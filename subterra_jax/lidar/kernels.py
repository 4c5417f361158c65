"""Which program casts, decided here alone: a kernel for NVIDIA GPUs, machine code for CPUs with numba, or XLA.

And single instructions of NVIDIA GPUs for kernels in Pallas: elsewhere, and in its interpreter where it lacks them,
plain arithmetic stands in for them.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from subterra_jax import native


def on_nvidia() -> bool:
    """Tell whether this process computes on an NVIDIA GPU."""
    return jax.default_backend() == "gpu" and "nvidia" in jax.devices()[0].device_kind.lower()


def present() -> bool:
    """Tell whether this process has kernels for its device."""
    return on_nvidia() or native.supported()


def fastest(by_xla: Callable[..., Any], on_gpu: Callable[..., Any], on_cpu: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that runs as the fastest program for the device on which it runs.

    Args:
        by_xla: The function, for any device.
        on_gpu: The same for NVIDIA GPUs.
        on_cpu: The same for CPUs; called only where there is numba.
    """

    def call(*args: Any) -> Any:
        kernels = {"cuda": on_gpu} if on_nvidia() else {}
        if native.supported():
            kernels["cpu"] = on_cpu
        return lax.platform_dependent(*args, **kernels, default=by_xla)

    return call


def compiled_by_numba(name: str) -> Callable[..., Any]:
    """Return a function of `native.calls` by its name; numba, which is optional, is loaded when it is called."""

    def call(*args: Any) -> Any:
        from subterra_jax.native import calls

        return getattr(calls, name)(*args)

    return call


def load_words(ref: Any, start: Array, n_words: int = 4) -> tuple[Array, ...]:
    """Return 2 or 4 words of each of many rows of a flat array, read by one instruction.

    The first word of a row is a multiple of their number.
    """
    from jax.experimental.pallas import triton

    column = jax.lax.broadcasted_iota(jnp.int32, (*start.shape, n_words), start.ndim)
    words = triton.load(ref.at[start[..., None] + column])
    zero = jnp.zeros_like(words)
    # Where JAX has 64 bits, it would sum words in as many.
    return tuple(jnp.sum(jnp.where(column == i, words, zero), axis=-1, dtype=words.dtype) for i in range(n_words))


def most(number: Array) -> Array:
    """Return the largest of the whole numbers of all threads of a program."""
    # In one row, for which a warp has an instruction; by rows and columns it takes five exchanges.
    return jnp.max(number.reshape(-1))


def fma(a: Array, b: Any, c: Any) -> Array:
    """Return a · b + c by one instruction: XLA keeps Triton from joining the two."""
    if jax.default_backend() != "gpu":
        return a * b + c
    return _instruction("fma.rn.f32 $0, $1, $2, $3;", "=f,f,f,f", a, b, c)


def reciprocal(a: Array) -> Array:
    """Return 1 / a, off by a last bit at most; of what is not a normal number 0, or infinity."""
    if jax.default_backend() != "gpu":
        return 1.0 / a
    return _instruction("rcp.approx.ftz.f32 $0, $1;", "=f,f", a)


def _instruction(text: str, constraints: str, *numbers: Any) -> Array:
    from jax.experimental.pallas import triton

    shape = jnp.broadcast_shapes(*(jnp.shape(number) for number in numbers))
    arguments = [jnp.broadcast_to(jnp.asarray(number, jnp.float32), shape) for number in numbers]
    out = jax.ShapeDtypeStruct(shape, jnp.float32)
    (result,) = triton.elementwise_inline_asm(
        text, args=arguments, constraints=constraints, pack=1, result_shape_dtypes=[out]
    )
    return result
