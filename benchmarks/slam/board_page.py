"""The arena's board as a Markdown table, as records, and as the figure of the dial."""

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.records import Record, commit, of_facts
from benchmarks.results import png_bytes

Row = dict[str, Any]
_DIAL = ("walls-smooth", "walls-joints", "walls-pockets", "walls-furnished", "walls-sprayed")
_BEAMS = ("beams-06", "walls-furnished", "beams-32", "beams-64")
_DUST = ("walls-furnished", "dust-half", "dust-lock")
_REST = ("motion-walk", "motion-b2")
_NAMES = {
    "walls-smooth": "smooth", "walls-joints": "joints", "walls-pockets": "pockets", "walls-furnished": "furnished",
    "walls-sprayed": "sprayed", "beams-06": "6 beams", "beams-32": "32 beams", "beams-64": "64 beams",
    "dust-half": "thin dust", "dust-lock": "own cloud", "motion-walk": "walked", "motion-b2": "B2",
}  # fmt: skip
_OURS = {  # colour, marker and line of what is not a SLAM program
    "wheel-odometry": ("0.3", "s", ":"), "ring-filter": ("0.0", "D", "-."), "particle-filter": ("0.5", "D", "--"),
}  # fmt: skip
_ASIDE = 0.04  # of the distance between two recordings, from one program to the next
_LEAST = 3e-5  # m per 100 m, lower end of the figure


def median_drift(rows: list[Row], program: str, recording: str) -> tuple[float, float, float] | None:
    """Returns median, least and largest axial drift per 100 m over the sets, m; `None` where a run failed."""
    some = [row for row in rows if row["program"] == program and row["recording"] == recording]
    if not some or any("failed" in row for row in some):
        return None
    values = [float(row["drift"]) for row in some]
    return float(np.median(values)), min(values), max(values)


def as_table(board: dict[str, Any]) -> str:
    """Returns the table as Markdown: drift per 100 m for each program and recording."""
    rows, names = board["rows"], [name for name in _NAMES if any(row["recording"] == name for row in board["rows"])]
    programs = list(dict.fromkeys(row["program"] for row in rows))
    head = ["program", "runs", *(_NAMES[name] for name in names), "across, m", "reach, m", "of real time"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for program in sorted(programs, key=lambda one: _rank(rows, one)):
        cells = [_cell(median_drift(rows, program, name)) for name in names]
        runs = str(sum(row["program"] == program for row in rows))
        lines.append(f"| {' | '.join([program, runs, *cells, *_sums(rows, program)])} |")
    for name, digits in (("drift", 4), ("gate", 3)):
        values = [f"{_of(board['floors'], recording, name):.{digits}f}" for recording in names]
        lines.append(f"| *{'floor' if name == 'drift' else name}* | | {' | '.join(values)} | | | |")
    return "\n".join([*lines, ""])


def as_markdown(board: dict[str, Any]) -> str:
    """Returns the table, what its columns are, and the failures with their reasons."""
    note = (
        "Axial drift, m per 100 m: median of the sets (least to largest). *Across*: RMS, median of all recordings. "
        "*Reach*: distance driven before 1 m of axial error, median of the recordings where it is exceeded. "
        "*Floor*: bound of the drift, whatever program reads the ranges. *Gate*: least eigenvalue of scan matching."
    )
    failed = [f"- {one}" for one in _failures(board["rows"])]
    return "\n".join([as_table(board), note, "", *(["Failed:", "", *failed, ""] if failed else [])])


def records_of(board: dict[str, Any]) -> list[Record]:
    """Returns the drift of each program on each recording, its error across, floor and gate as records."""
    rows, count = board["rows"], len({row["set"] for row in board["rows"]})
    facts = {**of_facts(board), "n": count, "seed": None, "commit": commit(), "tolerance": 1.0}
    where = "drives of the arena; interval: least to largest of the seeds"
    found = []
    for program in dict.fromkeys(row["program"] for row in rows):
        command = f"benchmarks.slam run --library {program} --recordings out/arena --out out/slam/{program}"
        for recording, name in _NAMES.items():
            if (drift := median_drift(rows, program, recording)) is not None:
                middle, low, high = (round(value, 2) for value in drift)
                id = f"arena/{program}/{name.replace(' ', '-').lower()}"
                found.append(Record(id, middle, "%", (low, high), split=where, command=command, **facts))
    for recording, name in _NAMES.items():
        if any(row["recording"] == recording for row in rows):
            command = "benchmarks.slam board --sets out/arena --out out/slam/board"
            floor = round(_of(board["floors"], recording, "drift"), 4)
            id = f"arena/floor/{name.replace(' ', '-').lower()}"
            found.append(Record(id, floor, "%", None, split=where, command=command, **facts))
    return found


def _failures(rows: list[Row]) -> list[str]:
    """Returns a line for each program, recording and reason, with the sets in which it failed."""
    sets: dict[str, list[str]] = {}
    for row in rows:
        if "failed" in row:
            sets.setdefault(f"{row['program']} on {row['recording']}: {row['failed']}", []).append(row["set"])
    return [f"{text} ({', '.join(names)})" for text, names in sets.items()]


def _rank(rows: list[Row], program: str) -> float:
    """Returns the median drift over all recordings; failures come last."""
    values = [row["drift"] if "failed" not in row else 1e9 for row in rows if row["program"] == program]
    return float(np.median(values))


def _cell(values: tuple[float, float, float] | None) -> str:
    if values is None:
        return "failed"
    middle, low, high = (f"{value:.2f}" if value < 10.0 else f"{value:.0f}" for value in values)
    return middle if low == high else f"{middle} ({low} to {high})"


def _sums(rows: list[Row], program: str) -> list[str]:
    some = [row for row in rows if row["program"] == program and "failed" not in row]
    reach = [row["reach"] for row in some if row["reach"] is not None]
    share = [row["share"] for row in some if "share" in row]
    parts = ([row["across_rms"] for row in some], reach, share)
    texts: tuple[Callable[[float], str], ...] = (
        lambda v: f"{v:.3f}", lambda v: f"{v:.0f} ({len(reach)}/{len(some)})", lambda v: f"{100.0 * v:.0f} %",
    )  # fmt: skip
    return [text(float(np.median(values))) if values else "" for text, values in zip(texts, parts, strict=True)]


def _of(floors: list[Row], recording: str, name: str) -> float:
    return float(np.median([row[name] for row in floors if row["recording"] == recording]))


def draw_board(board: dict[str, Any]) -> Figure:
    """Draws axial drift per 100 m against walls, beams, dust and carriers, beside the floor."""
    rows = board["rows"]
    held = {row["recording"] for row in rows}
    groups = [("walls", _DIAL), ("beams, furnished", _BEAMS), ("dust, furnished", _DUST), ("carried by", _REST)]
    panels = [(title, [name for name in names if name in held]) for title, names in groups]
    panels = [(title, names) for title, names in panels if names]
    widths = [max(1.2, len(names)) for _, names in panels]
    figure, axes = plt.subplots(
        1, len(panels), figsize=(11.0, 5.2), sharey=True, width_ratios=widths, layout="constrained", squeeze=False
    )
    for panel, (title, names) in zip(axes[0], panels, strict=True):
        _draw_panel(panel, board, title, names)
    axes[0, 0].set_ylabel("axial drift, m per 100 m")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure


def _draw_panel(axes: Axes, board: dict[str, Any], title: str, names: list[str]) -> None:
    rows, at = board["rows"], np.arange(len(names))
    programs = list(dict.fromkeys(row["program"] for row in rows))
    others = [name for name in programs if name not in _OURS]
    for k, program in enumerate(programs):
        found = [median_drift(rows, program, name) or (np.nan,) * 3 for name in names]
        middle, low, high = np.maximum(np.array(found, float), _LEAST).T
        colour, marker, style = _OURS.get(program) or (f"C{others.index(program) % 10}", "o", "-")
        place = at + _ASIDE * (k - 0.5 * (len(programs) - 1))
        axes.errorbar(
            place, middle, [middle - low, high - middle], marker=marker, ms=4, lw=1.2, capsize=2, color=colour,
            ls=style, label=program,
        )  # fmt: skip
    floor = [_of(board["floors"], name, "drift") for name in names]
    axes.plot(at, np.maximum(floor, _LEAST), "k--", lw=1.4, label="floor")
    axes.set_yscale("log")
    axes.set_ylim(_LEAST, 300.0)
    axes.set_xticks(at, [_tick(name, title) for name in names], rotation=35, ha="right")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3, which="major")
    axes.axhline(100.0, color="0.7", lw=0.8)


def _tick(recording: str, title: str) -> str:
    """Returns the label of a recording; the furnished drive ends three scales."""
    if recording != "walls-furnished" or title == "walls":
        return _NAMES[recording]
    return "16 beams" if title.startswith("beams") else "none"


def as_png(board: dict[str, Any]) -> bytes:
    """Returns the figure as a PNG file."""
    return png_bytes(draw_board(board), dpi=130)
