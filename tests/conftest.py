"""Compiles programs cheaply while the tests run, and once for all workers of a run and for the runs after it.

Most of what the simulator's tests take is XLA compiling programs that run for a moment. Without LLVM's optimisations
and fusion emitters it compiles five times as fast, and what comes out runs a third as fast. Where `XLA_FLAGS` is set,
be it to nothing, the tests run with that: `make test-slow` runs what users run.
"""

import ctypes
import gc
import os
import platform
import sys
import threading
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

_WEEK = 7 * 86_400.0  # s


def _kept_programs() -> Path:
    """Returns the folder in which programs outlast a run of this machine, freed of those that none has used lately."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = caches / "subterra-tests" / f"{platform.node()}-jax-{version('jax')}"
    folder.mkdir(parents=True, exist_ok=True)
    for used in folder.glob("*-atime"):
        if time.time() - used.stat().st_mtime > _WEEK:
            used.with_name(used.name.removesuffix("-atime") + "-cache").unlink(missing_ok=True)
            used.unlink(missing_ok=True)
    return folder


# Before jax is imported: XLA reads its flags once, and what a test starts inherits them.
# A flag that an XLA does not know ends the process: the emitters can be left out of jax 0.10 and no longer of 0.12.
_CHEAP = "--xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1 "  # a fifth less
_LEAVE_OUT = f"{_CHEAP}--xla_cpu_use_fusion_emitters=false " if version("jax").startswith("0.10.") else ""
os.environ.setdefault("XLA_FLAGS", f"{_LEAVE_OUT}--xla_backend_optimization_level=0")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # the first process of a run; its workers find it set
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(_kept_programs())
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")

import jax  # noqa: E402
import pytest  # noqa: E402
from jax._src.interpreters import mlir  # noqa: E402
from jax._src.lru_cache import LRUCache  # noqa: E402

# With a size, jax guards the folder by a lock: two workers may want the same program at once. But it then stats and
# reads every file of the folder at each program that it keeps, 0.2 s at 3,000 of them; nothing has to be evicted here.
jax.config.update("jax_compilation_cache_max_size", 8 * 2**30)
LRUCache._evict_if_needed = lambda self, **_: None  # type: ignore[method-assign]

_PROGRAMS_A_CONTEXT = 100
_make_context, _local = mlir.make_ir_context, threading.local()


def _shared_context() -> object:
    """Returns a thread's MLIR context for its next 100 programs: a fresh one for each is a quarter of a small one."""
    if getattr(_local, "left", 0) == 0:
        _local.context, _local.left = _make_context(), _PROGRAMS_A_CONTEXT
    _local.left -= 1
    return _local.context


mlir.make_ir_context = _shared_context  # type: ignore[assignment]

_CROWDED = 4e9
_MANY_PROGRAMS = 25
_COMPILED = "/jax/core/compile/backend_compile_duration"
_since_looked = 0


def pytest_collection_finish() -> None:
    """Tells the garbage collector to leave alone what was imported, and to walk seldom: tracing makes many objects."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


SLOW = Path(__file__).with_name("slow.txt")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks as slow what `slow.txt` names, so that the run of every change stays short; `make test-slow` runs it."""
    named = set(SLOW.read_text().splitlines())
    for item in items:
        function = item.nodeid.partition("[")[0]
        if named & {item.nodeid, function, function.partition("::")[0]}:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="module", autouse=True)
def bounded_memory() -> Iterator[None]:
    """Forgets compiled programs between files once the process has grown large; the folder still has them."""
    yield
    if resident() > _CROWDED:
        forget_programs()


def _count_program(event: str, *_: object, **__: object) -> None:
    """Counts programs that were compiled or read from the folder."""
    global _since_looked
    _since_looked += event == _COMPILED


jax.monitoring.register_event_duration_secs_listener(_count_program)


@pytest.fixture(autouse=True)
def bounded_maps() -> Iterator[None]:
    """Looks after every 25 programs or so whether memory maps run short."""
    global _since_looked
    yield
    if _since_looked >= _MANY_PROGRAMS:
        _since_looked = 0
        forget_programs_where_maps_run_short()


def forget_programs_where_maps_run_short() -> None:
    """Forgets compiled programs once the process has half of the memory maps that Linux allows.

    A program of XLA takes 20 to 600 of the 65,530; without any left LLVM returns nothing, and XLA ends the process by
    a segmentation fault as it writes that to the folder.
    """
    if _maps() > 0.5 * _map_limit():
        forget_programs()


def forget_programs() -> None:
    """Forgets compiled programs, and gives their memory back to the system.

    Without the second step the process stays as large as it ever was, and every file's programs were forgotten for the
    next one: a third of the time of the simulator's tests.
    """
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux" and platform.libc_ver()[0] == "glibc":
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def _maps() -> int:
    """Memory maps of this process; 0 where the system does not say."""
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0


def _map_limit() -> int:
    """Memory maps that a process may have."""
    limit = Path("/proc/sys/vm/max_map_count")
    return int(limit.read_text()) if limit.exists() else 65_530


def resident() -> float:
    """Memory of this process, bytes; 0 where the system does not say."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0.0
