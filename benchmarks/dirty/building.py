"""Builds of cases by the command line, each in a process of its own, as a user would run them."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

from benchmarks.dirty.truth import Case

_WARNING = re.compile(r"^\s*(?:\[[^\]]*\]\s*)?warning:?\s*(.+)$", re.IGNORECASE)
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
TIMED_OUT = -1  # status of a build that was ended because it took too long


@dataclass(frozen=True)
class Built:
    """Outcome of one build."""

    status: int  # Exit status; `TIMED_OUT` where it was ended
    message: str  # Last line of stderr, which is the sentence of an error; empty after a success
    warnings: tuple[str, ...]  # Warnings of the manifest, and those printed, each once
    seconds: float  # Wall-clock time, s
    memory: float  # Peak memory, GiB


def build_case(case: Case, scene: Path, log: Path, flags: tuple[str, ...] = (), limit: float = 900.0) -> Built:
    """Builds the scene of a case.

    Args:
        case: The case.
        scene: Folder for the scene.
        log: File for everything that the build prints.
        flags: Further words for the builder, after those of the case.
        limit: Longest time, s.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, "-m", "scene.build", *case.words, "--out", str(scene), "--fresh", *flags]
    started = time.monotonic()
    with log.open("wb") as out:
        process = subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT)
        with _ended_after(limit, process):
            _, status, usage = os.wait4(process.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    lines = [line.strip() for line in log.read_text(errors="replace").replace("\r", "\n").splitlines() if line.strip()]
    printed = [found[1] for line in lines if (found := _WARNING.match(line))]
    code = TIMED_OUT if code == -signal.SIGKILL else code
    warnings = tuple(dict.fromkeys([*manifest_warnings(scene), *printed])) if code == 0 else tuple(printed)
    message = "" if code == 0 else f"ended after {limit:g} s" if code == TIMED_OUT else (lines or [""])[-1]
    return Built(code, message, warnings, time.monotonic() - started, usage.ru_maxrss / 2**20)


def take_processor(places: "Queue[int]") -> None:
    """Ties this process, and the builds that it will start, to one processor and to one thread of each library.

    Args:
        places: Numbers from which each process takes its own; beyond the processors they begin again.
    """
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    place = places.get()
    if hasattr(os, "sched_setaffinity"):
        mine = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {mine[place % len(mine)]})


def manifest_warnings(scene: Path) -> list[str]:
    """Return the warnings of a scene's manifest as sentences."""
    manifest: dict[str, Any] = json.loads((scene / "manifest.json").read_text())
    return [str(entry["text"]) for entry in manifest.get("judgement", {}).get("warnings", [])]


@contextmanager
def _ended_after(limit: float, process: "subprocess.Popen[bytes]") -> Iterator[None]:
    """Kills the process when its time is over."""

    def end(number: int, frame: object) -> None:
        process.kill()

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        yield
    except BaseException:
        process.kill()
        process.wait()
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
