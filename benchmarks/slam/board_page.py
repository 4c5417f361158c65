"""The arena's board as a Markdown table, as records, and as the figure of the dial."""

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.records import Record, of_facts
from benchmarks.results import markdown_table
from benchmarks.slam.programs import PROGRAMS, WHEELS

Row = dict[str, Any]
_PANELS = {
    "walls": ("walls-smooth", "walls-joints", "walls-pockets", "walls-furnished", "walls-sprayed"),
    "beams, furnished": ("beams-06", "walls-furnished", "beams-32", "beams-64"),
    "dust, furnished": ("walls-furnished", "dust-half", "dust-lock"),
    "carried by": ("motion-walk", "motion-b2"),
    "texture, smooth": ("walls-smooth", "texture-smooth-25", "texture-smooth-50", "texture-smooth-100"),
    "texture 1": ("texture-joints-100", "texture-sprayed-100"),
    "Doppler": ("doppler-smooth",),
}
_NAMES = {
    "walls-smooth": "smooth", "walls-joints": "joints", "walls-pockets": "pockets", "walls-furnished": "furnished",
    "walls-sprayed": "sprayed", "beams-06": "6 beams", "beams-32": "32 beams", "beams-64": "64 beams",
    "dust-half": "thin dust", "dust-lock": "own cloud", "motion-walk": "walked", "motion-b2": "B2",
    "texture-smooth-25": "smooth, texture 0.25", "texture-smooth-50": "smooth, texture 0.5",
    "texture-smooth-100": "smooth, texture 1", "texture-joints-100": "joints, texture 1",
    "texture-sprayed-100": "sprayed, texture 1", "doppler-smooth": "smooth, Doppler",
}  # fmt: skip
# Colour and marker of a program, in every figure, so that grey tells them apart; diamonds are ours.
_STYLES = {name: (plt.get_cmap("tab20")(k % 20), "oP^Xv>p<h*8"[k % 11] if one.package else "D") for k, (name, one) in
           enumerate(PROGRAMS.items())} | {WHEELS: ("0.3", "s")}  # fmt: skip
_ASIDE = 0.05  # of the distance between two recordings, from one program to the next
_LEAST = 3e-5  # m per 100 m, lower end of the figure


def median_drift(rows: list[Row], program: str, recording: str) -> tuple[float, float, float] | None:
    """Returns median, least and largest axial drift per 100 m over the sets, m; `None` where a run failed."""
    some = [row for row in rows if row["program"] == program and row["recording"] == recording]
    if not some or any("failed" in row for row in some):
        return None
    values = [float(row["drift"]) for row in some]
    return float(np.median(values)), min(values), max(values)


def as_markdown(board: dict[str, Any]) -> str:
    """Returns the table, what its columns are, and the failures with their reasons."""
    rows, names = board["rows"], _held(board)
    head = ["program", "runs", *(_NAMES[name] for name in names), "across, m", "reach, m", "of real time"]
    lines = []
    drift = {one: np.median([row["drift"] if "failed" not in row else 1e9 for row in rows if row["program"] == one])
             for one in _programs(board)}  # of all recordings; failures come last  # fmt: skip
    for program in sorted(drift, key=drift.__getitem__):
        runs = str(sum(row["program"] == program for row in rows))
        lines.append([program, runs, *(_cell(rows, program, name) for name in names),
                      *_sums(rows, program)])  # fmt: skip
    lines.append(["*floor*", "", *(f"{_floor(board, name):.4f}" for name in names), "", "", ""])
    note = (
        "Axial drift, m per 100 m: median of the sets (least to largest). *Across*: RMS, median of all recordings. "
        "*Reach*: distance driven before 1 m of axial error, median of the recordings where it is exceeded. "
        "*Floor*: bound of the drift, whatever program reads the ranges."
    )
    failed = [f"- {one}" for one in _failures(rows)]
    return markdown_table(head, lines) + "\n".join(["", note, "", *(["Failed:", "", *failed, ""] if failed else [])])


def _held(board: dict[str, Any]) -> list[str]:
    held = {row["recording"] for row in board["rows"]}
    return [name for name in _NAMES if name in held]


def _programs(board: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(row["program"] for row in board["rows"]))


def records_of(board: dict[str, Any]) -> list[Record]:
    """Returns the drift of each program on each recording, and its floor, as records."""
    facts = {**of_facts(board), "n": len({row["set"] for row in board["rows"]}), "seed": None, "tolerance": 1.0}
    facts["split"] = "drives of the arena; interval: least to largest of the seeds"
    found = []
    for recording in _held(board):
        name = _NAMES[recording].replace(",", "").replace(" ", "-").lower()
        for program in _programs(board):
            if (drift := median_drift(board["rows"], program, recording)) is not None:
                middle, low, high = (round(value, 2) for value in drift)
                command = f"benchmarks.slam board --sets out/arena --programs {program} --out out/slam/board"
                found.append(Record(f"arena/{program}/{name}", middle, "%", (low, high), command=command, **facts))
        command = "benchmarks.slam board --sets out/arena --out out/slam/board"
        floor = round(_floor(board, recording), 4)
        found.append(Record(f"arena/floor/{name}", floor, "%", None, command=command, **facts))
    return found


def _failures(rows: list[Row]) -> list[str]:
    """Returns a line for each program, recording and reason, with the sets in which it failed."""
    sets: dict[str, list[str]] = {}
    for row in rows:
        if "failed" in row:
            sets.setdefault(f"{row['program']} on {row['recording']}: {row['failed']}", []).append(row["set"])
    return [f"{text} ({', '.join(names)})" for text, names in sets.items()]


def _cell(rows: list[Row], program: str, recording: str) -> str:
    if (values := median_drift(rows, program, recording)) is None:
        ran = any(row["program"] == program and row["recording"] == recording for row in rows)
        return "failed" if ran else ""
    middle, low, high = (f"{value:.2f}" if value < 10.0 else f"{value:.0f}" for value in values)
    return middle if low == high else f"{middle} ({low} to {high})"


def _sums(rows: list[Row], program: str) -> list[str]:
    """Returns the medians of the error across, the reach and the fraction of real time."""
    some = [row for row in rows if row["program"] == program and "failed" not in row]
    reach = [row["reach"] for row in some if row["reach"] is not None]
    parts: tuple[tuple[list[float], Callable[[float], str]], ...] = (
        ([row["across_rms"] for row in some], lambda value: f"{value:.3f}"),
        (reach, lambda value: f"{value:.0f} ({len(reach)}/{len(some)})"),
        ([row["share"] for row in some if "share" in row], lambda value: f"{100.0 * value:.0f} %"),
    )
    return [text(float(np.median(values))) if values else "" for values, text in parts]


def _floor(board: dict[str, Any], recording: str) -> float:
    return float(np.median([row["drift"] for row in board["floors"] if row["recording"] == recording]))


def draw_board(board: dict[str, Any]) -> Figure:
    """Draws axial drift per 100 m against walls, beams, dust and carriers, beside the floor."""
    held = _held(board)
    panels = {title: [name for name in names if name in held] for title, names in _PANELS.items()}
    panels = {
        title: names for title, names in panels.items() if names and (title == "walls" or names != ["walls-smooth"])
    }
    widths = [max(1.2, len(names)) for names in panels.values()]
    figure, axes = plt.subplots(
        1, len(panels), figsize=(13.0, 5.2), sharey=True, width_ratios=widths, layout="constrained", squeeze=False
    )
    for panel, (title, names) in zip(axes[0], panels.items(), strict=True):
        _draw_panel(panel, board, title, names)
    axes[0, 0].set_ylabel("axial drift, m per 100 m")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure


def _draw_panel(axes: Axes, board: dict[str, Any], title: str, names: list[str]) -> None:
    at, programs = np.arange(len(names)), _programs(board)
    for k, program in enumerate(programs):
        found = [median_drift(board["rows"], program, name) or (np.nan,) * 3 for name in names]
        middle, low, high = np.maximum(np.array(found, float), _LEAST).T
        colour, marker = _STYLES.get(program, ("k", "x"))
        place = at + _ASIDE * (k - 0.5 * (len(programs) - 1))
        axes.errorbar(
            place, middle, [middle - low, high - middle], fmt=marker, ms=5, lw=1.2, capsize=2, color=colour,
            label=program,
        )  # fmt: skip
    floor = np.maximum([_floor(board, name) for name in names], _LEAST)
    axes.hlines(floor, at - 0.4, at + 0.4, colors="k", linestyles="--", lw=1.4, label="floor")
    axes.set_yscale("log")
    axes.set_ylim(_LEAST, 300.0)
    axes.set_xticks(at, [_tick(name, title) for name in names], rotation=35, ha="right")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3, which="major")
    axes.axhline(100.0, color="0.7", lw=0.8)


def _tick(recording: str, title: str) -> str:
    """Returns the label of a recording; two drives stand on several scales."""
    if title.startswith("texture,"):
        return _NAMES[recording].removeprefix("smooth, texture ").replace("smooth", "0")
    if title in ("texture 1", "Doppler"):
        return _NAMES[recording].partition(",")[0]
    if recording != "walls-furnished" or title == "walls":
        return _NAMES[recording]
    return "16 beams" if title.startswith("beams") else "none"
