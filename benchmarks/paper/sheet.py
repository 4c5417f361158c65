"""Figures at the size and in the type of an IEEE page, and their files."""

import csv
import json
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.fidelity.files import round_floats, write_text
from subterra_jax.host.files import replace_file

SCHEMA = "subterra.figure/1"
COLUMN, PAGE = 3.5, 7.16  # in; widths of one and of two columns, IEEE's guide for authors
DPI = 300
_FILES = ("pdf", "png", "csv", "json")
_STYLE: dict[Any, Any] = {
    "font.family": "STIXGeneral",  # as narrow as Times, and comes with Matplotlib, so that every machine draws the same
    "mathtext.fontset": "stix",
    "font.size": 8.0,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "pdf.fonttype": 42,  # TrueType: text stays text, and publishers take it
}


@dataclass(frozen=True)
class Drawing:
    """A figure with its data.

    Attributes:
        figure: Figure as printed.
        caption: Caption below it.
        columns: Columns of the CSV by heading, all of one length.
        facts: Numbers for the JSON.
    """

    figure: Figure
    caption: str
    columns: Mapping[str, np.ndarray]
    facts: Mapping[str, Any]


@contextmanager
def style() -> Iterator[None]:
    """Sets fonts and lines for print while figures are drawn inside."""
    with plt.rc_context(_STYLE):
        yield


def is_made(folder: Path, name: str, key: str) -> bool:
    """Returns whether a figure is there with all its files, from the same inputs and code."""
    if not all((folder / f"{name}.{suffix}").exists() for suffix in _FILES):
        return False
    try:
        return bool(json.loads((folder / f"{name}.json").read_text())["key"] == key)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def save(drawing: Drawing, folder: Path, name: str, extra: Mapping[str, Any]) -> None:
    """Writes PDF, PNG, CSV and, last, JSON.

    Args:
        drawing: Figure and data; the figure is closed afterwards.
        folder: Output folder.
        name: File name without suffix.
        extra: Further entries of the JSON; `provenance` is printed below the figure as well.

    Raises:
        OutputError: A file cannot be written.
    """
    _print_provenance(drawing.figure, str(extra["provenance"]))
    try:
        for suffix in ("pdf", "png"):
            with replace_file(folder / f"{name}.{suffix}") as fresh:
                metadata = {"CreationDate": None} if suffix == "pdf" else {}
                drawing.figure.savefig(fresh, dpi=DPI, format=suffix, metadata=metadata)
        _write_table(folder / f"{name}.csv", drawing.columns)
    finally:
        plt.close(drawing.figure)
    content = {"schema": SCHEMA, "caption": drawing.caption, "facts": drawing.facts, **extra}
    write_text(folder / f"{name}.json", json.dumps(round_floats(content), indent=1, sort_keys=True) + "\n")


def code_hash() -> str:
    """Returns the SHA-256 of this folder's code: a figure drawn by other code is drawn again."""
    digest = sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _print_provenance(figure: Figure, provenance: str) -> None:
    width = figure.get_figwidth()
    lines = textwrap.fill(provenance, int(36.0 * width))  # characters of 5 points to an inch, on average
    figure.supxlabel(lines, fontsize=5.0, color="0.35", x=0.01, ha="left")


def _write_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    texts = [[_cell(value) for value in np.asarray(column).tolist()] for column in columns.values()]
    with replace_file(path) as fresh, fresh.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*texts, strict=True))


def _cell(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
