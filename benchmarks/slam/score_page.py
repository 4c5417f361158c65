"""Scores as a table and as JSON, and the figure of errors against distance."""

import dataclasses
import json
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.results import markdown_table
from benchmarks.slam.score import SCHEMA, ProgramScore

HEAD = (
    "recording", "program", "driven, m", "covered %", "along at the end, m", "drift %", "along, m", "across, m",
    "up, m", "along % of pieces", "across % of pieces", "turn, °/m", "APE, m", "RPE, m",
)  # fmt: skip
_STYLES = ("-", "--", ":", "-.")


def as_rows(scores: list[ProgramScore]) -> list[tuple[str, ...]]:
    """Returns the cells of the table below `HEAD`, by recording and program."""

    def cell(value: float | None, digits: int = 2) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    rows: list[tuple[str, ...]] = []
    for one in sorted(scores, key=lambda one: (one.score.name, one.program)):
        s = one.score
        rows.append((
            s.name, one.program, cell(s.distance, 1), cell(100.0 * s.covered, 0), f"{s.along_final:+.2f}",
            cell(s.drift), cell(s.along_rms, 3), cell(s.across_rms, 3), cell(s.up_rms, 3), cell(s.piece_along),
            cell(s.piece_across), cell(s.piece_turn, 3), cell(s.ape.rmse, 3),
            cell(None if s.rpe is None else s.rpe.rmse, 3),
        ))  # fmt: skip
    return rows


def as_markdown(scores: list[ProgramScore]) -> str:
    """Returns the table with a note on its columns."""
    first = scores[0].score
    return markdown_table(HEAD, as_rows(scores)) + (
        f"\nRoot mean squares over the recording, alignment `{first.alignment}`. Pieces are {first.piece:g} m of path: "
        "RMS error of their motion in % of it. APE and RPE are root mean squares as `evo` defines them.\n"
    )


def as_json(scores: list[ProgramScore], facts: dict[str, Any]) -> str:
    """Returns `scores.json`."""
    rows = [{"program": one.program, **dataclasses.asdict(one.score)} for one in scores]
    return json.dumps({"schema": SCHEMA, **facts, "scores": rows}, indent=1, default=str) + "\n"


def draw(scores: list[ProgramScore]) -> Figure:
    """Draws errors against distance: a colour for each program, a line style for each recording."""
    programs = list(dict.fromkeys(one.program for one in scores))
    names = list(dict.fromkeys(one.score.name for one in scores))
    figure, panels = plt.subplots(2, 1, figsize=(8.0, 6.0), sharex=True, layout="constrained")
    for part, (axes, title) in enumerate(zip(panels, ("along the axis", "across it"), strict=True)):
        for one in scores:
            style = _STYLES[names.index(one.score.name) % len(_STYLES)]
            axes.plot(
                one.curve.travelled, one.curve.error[:, part], style, color=f"C{programs.index(one.program) % 10}",
                lw=1.4, label=f"{one.program}, {one.score.name}",
            )  # fmt: skip
        axes.axhline(0.0, color="0.6", lw=0.8, zorder=0)
        axes.set_ylabel(f"error {title}, m")
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("distance driven, m")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure
