"""Writing of results: facts of the machine, tables, pictures, files whole or not at all."""

import io
import os
import platform
import subprocess
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from subterra_jax.host.files import replace_file

UNKNOWN = "unknown"
_PACKAGES = ("jax", "jaxlib", "flax", "numpy", "mujoco", "jaxmarl", "gymnax", "subterra-jax")


def environment_facts() -> dict[str, Any]:
    """Returns date (UTC), hardware, commit and versions; `None` for a package that is not installed."""
    device = jax.devices()[0]
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": device.device_kind if device.platform != "cpu" else _processor(),
        "platform": device.platform,
        "n_devices": len(jax.devices()),
        "processor": _processor(),
        "cpu_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "python": platform.python_version(),
        "commit": commit(),
        **{name: version(name) for name in _PACKAGES},
    }


def commit() -> str:
    """Returns the commit of this checkout; `unknown` where there is none."""
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN


def version(package: str) -> str | None:
    """Returns a package's version; `None` where it is not installed, or runs from a checkout that was not."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def write_file(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all, and its folder where it is missing.

    Raises:
        OutputError: The file cannot be written.
    """
    with replace_file(path) as fresh:
        fresh.write_bytes(content)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table that ends with a line break; a `|` in a cell becomes a slash."""
    lines = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:], ""])


def png_bytes(figure: Figure, dpi: int, **options: Any) -> bytes:
    """Returns a figure as a PNG file and closes it; `options` go to `savefig`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, **options)
    plt.close(figure)
    return buffer.getvalue()


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
