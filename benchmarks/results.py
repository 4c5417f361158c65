"""Facts that every result file carries, and files written whole or not at all."""

import os
import platform
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from subterra_jax import tasks

_PACKAGES = ("jax", "jaxlib", "flax", "numpy", "mujoco", "jaxmarl", "gymnax", "subterra-jax")


def environment_facts() -> dict[str, Any]:
    """Return date (UTC), hardware and versions; `None` for a package that is not installed."""
    device = jax.devices()[0]
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": device.device_kind if device.platform != "cpu" else _processor(),
        "platform": device.platform,
        "n_devices": len(jax.devices()),
        "processor": _processor(),
        "cpu_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in _PACKAGES},
    }


def constants_facts() -> dict[str, str]:
    """Return the digest of the benchmark's constants; empty where `subterra_jax.tasks` has none to give."""
    digest = getattr(tasks, "constants_digest", None)
    return {} if digest is None else {"constants_sha256": str(digest())}


def version(package: str) -> str | None:
    """Return a package's version; `None` where it is not installed, or runs from a checkout that was not."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def write_file(path: Path, content: bytes) -> None:
    """Writes a file under a temporary name, then renames it, so that no half-written file is left.

    Raises:
        OSError: The file cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(content)
    partial.replace(path)


def _processor() -> str:
    """Return the processor's name, as far as the system gives it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
