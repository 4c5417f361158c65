"""Compiles the methods of an environment at their first use, and keeps programs on disk; modes of JAX."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import platform
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import cache_folder, make_writable

_Method = TypeVar("_Method", bound=Callable[..., Any])


# Of a CPU: compiles in a fourth of the time what runs half as long again. An XLA may know some of them alone.
_IN_HASTE = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def compiled(*static: str, in_haste: bool = False) -> Callable[[_Method], _Method]:
    """Compile a method at its first use, for all objects that are equal.

    Inside a function that is compiled itself nothing changes. An object that cannot be hashed, as one with a part that
    is no frozen dataclass, runs without.

    Args:
        *static: Names of arguments that are part of the program.
        in_haste: Compile quickly what a CPU runs by itself: a first call must not take seconds, and who calls a single
            step from Python waits longer for Python than for the step.
    """

    def decorate(method: _Method) -> _Method:
        names = ("self", *static)
        program = jax.jit(method, static_argnames=names, inline=True)
        alone = functools.cache(lambda: jax.jit(method, static_argnames=names, compiler_options=_options_in_haste()))

        @functools.wraps(method)
        def call(self: Any, *args: Any, **kwargs: Any) -> Any:
            if not hashable(self):
                return method(self, *args, **kwargs)
            hastes = in_haste and jax.default_backend() == "cpu" and not _is_traced((args, kwargs, jnp.zeros(())))
            return (alone() if hastes else program)(self, *args, **kwargs)

        return call  # type: ignore[return-value]

    return decorate


@functools.cache
def _options_in_haste() -> dict[str, Any]:
    """Return those of `_IN_HASTE` that this XLA knows."""
    known = {}
    for name, value in _IN_HASTE.items():
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0).compile()
            known[name] = value
    return known


@contextlib.contextmanager
def in_32_bits() -> Iterator[None]:
    """Compute as JAX does by default, whatever the mode: 32 bits, lenient promotion; agents do. Also a decorator."""
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def cache_programs(folder: str | Path | None = None) -> Path:
    """Keep compiled programs on disk, so that the next process need not compile them again.

    This switches JAX's persistent cache on, for all programs of this process that take 0.1 s or more to compile.
    `make` does so too, unless JAX has a folder already or `JAX_ENABLE_COMPILATION_CACHE=false` forbids it. Importing
    the package does not. The folder may be deleted at any time, and nothing limits its size: the programs of one task
    take about 1 MB.

    Args:
        folder: Folder to keep them in. None is `JAX_COMPILATION_CACHE_DIR` if it is set, else a folder for this kind of
            processor under `~/.cache/subterra`, or `XDG_CACHE_HOME`.

    Returns:
        The folder.

    Raises:
        SubterraError: The folder cannot be written.
    """
    config: Any = jax.config
    if folder is None and config.jax_compilation_cache_dir:
        return Path(config.jax_compilation_cache_dir)
    if folder is None:
        folder = cache_folder("compiled") / _processor()
    folder = Path(folder)
    if not make_writable(folder):
        raise SubterraError(f"{folder}: cannot be written")
    config.update("jax_compilation_cache_dir", str(folder))
    config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    compilation_cache.reset_cache()  # JAX asks once, at the first program, whether there is a folder
    return folder


def keep_programs() -> None:
    """Do as `cache_programs`, unless JAX has a folder or is asked to keep nothing, or the folder cannot be written."""
    config: Any = jax.config
    if config.jax_compilation_cache_dir is None and config.jax_enable_compilation_cache:
        with contextlib.suppress(SubterraError):
            cache_programs()


def _processor() -> str:
    """Return a name of this machine's kind of processor: machine code for one need not run on another."""
    features = platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        features += next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:12]}"


def hashable(value: Any) -> bool:
    """Tell whether a value can be a static argument."""
    try:
        hash(value)
    except TypeError:
        return False
    return True


def _is_traced(tree: Any) -> bool:
    """Tell whether an array of a pytree stands for one that a transformation of JAX will fill in."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
