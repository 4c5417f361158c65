"""Compilation of a small function for the CPU as one kernel.

XLA's CPU runtime calls one kernel for each fused operation and hands them to its thread pool. A step of one environment
is a hundred kernels of under a microsecond, so that handing over takes longer than all the work. A call marked as small
is compiled as one function instead; XLA marks small loops so by itself.

Source: XLA, `ThunkEmitter::EmitCallThunk` and `SmallWhileLoopHoistingPass`. An XLA that does not know the mark ignores
it, and the program runs as it would have without.
"""

from collections.abc import Callable
from typing import Any

import jax

_MARK = {"xla_cpu_small_call": "true", "inlineable": "false"}


def compile_as_one_kernel(function: Callable[..., Any], *examples: Any) -> Callable[..., Any]:
    """A function compiled ahead of time for the first CPU, whatever the default device.

    Args:
        function: Pure; called with arrays, gives a pytree of arrays.
        *examples: Arrays, or shapes and dtypes, of its arguments.

    Returns:
        The compiled function, which takes exactly such arguments. Operations that cannot be part of one kernel, as a
        sort, are compiled in the usual way, along with all the rest.
    """
    inner = jax.jit(function)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        try:
            from jax.experimental.xla_metadata import set_xla_metadata

            return jax.jit(lambda *args: set_xla_metadata(inner(*args), **_MARK)).lower(*examples).compile()
        except (ImportError, TypeError, jax.errors.JaxRuntimeError):
            return inner.lower(*examples).compile()
