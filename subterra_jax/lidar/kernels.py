"""Which program casts, decided here alone: a kernel for NVIDIA GPUs, machine code for CPUs with numba, or XLA."""

from collections.abc import Callable
from typing import Any

from jax import lax

from subterra_jax import native
from subterra_jax.lidar import nvidia


def present() -> bool:
    """Tell whether this process has kernels for its device."""
    return nvidia.present() or native.supported()


def fastest(by_xla: Callable[..., Any], on_gpu: Callable[..., Any], on_cpu: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that runs as the fastest program for the device on which it runs.

    Args:
        by_xla: The function, for any device.
        on_gpu: The same for NVIDIA GPUs.
        on_cpu: The same for CPUs; called only where there is numba.
    """

    def call(*args: Any) -> Any:
        kernels = {"cuda": on_gpu} if nvidia.present() else {}
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
