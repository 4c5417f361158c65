"""The time line of a command: where its seconds went, from the start of the process."""

import time
from pathlib import Path

_laps: dict[str, float] = {}


def _process_age() -> float:
    """Returns the age of this process, s; 0 where the system does not tell."""
    try:
        ticks = float(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return max(float(Path("/proc/uptime").read_text().split()[0]) - ticks / 100.0, 0.0)
    except (OSError, ValueError, IndexError):
        return 0.0


_last = time.perf_counter() - _process_age()


def lap(name: str) -> None:
    """Adds the time since the last call, or since the process began, to a name."""
    global _last
    now = time.perf_counter()
    _laps[name] = _laps.get(name, 0.0) + now - _last
    _last = now


def line() -> str:
    """Returns all laps in one line, s, and their sum."""
    parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in _laps.items())
    return f"time: {parts}; {sum(_laps.values()):.1f} s in all"
