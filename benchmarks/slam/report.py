"""Scores as tables, JSON and a figure of errors along the axis and across it against the distance driven."""

import io
import json
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.slam.score import SCHEMA, ProgramScore

_HEAD = (
    "recording", "program", "driven, m", "covered %", "along at the end, m", "drift %", "along, m", "across, m",
    "up, m", "along % of pieces", "across % of pieces", "turn, °/m", "APE, m", "RPE, m",
)  # fmt: skip


def as_rows(scores: list[ProgramScore]) -> list[tuple[str, ...]]:
    """Return the cells of the table, head first."""
    return [_HEAD, *(_row(one) for one in sorted(scores, key=lambda one: (one.score.name, one.program)))]


def as_markdown(scores: list[ProgramScore]) -> str:
    """Return the table as Markdown, with a note on its columns."""
    rows = [f"| {' | '.join(row)} |" for row in as_rows(scores)]
    first = scores[0].score
    note = (
        f"Root mean squares over the recording, alignment `{first.alignment}`. Pieces are {first.piece:g} m of path: "
        "RMS error of their motion in % of it. APE and RPE are root mean squares as `evo` defines them."
    )
    return "\n".join([rows[0], "|" + "---|" * len(_HEAD), *rows[1:], "", note, ""])


def as_json(scores: list[ProgramScore], facts: dict[str, Any]) -> str:
    """Return `scores.json`."""
    rows = [{"program": one.program, **one.score.as_dict()} for one in scores]
    return json.dumps({"schema": SCHEMA, **facts, "scores": rows}, indent=1, default=str) + "\n"


def _row(one: ProgramScore) -> tuple[str, ...]:
    score = one.score
    return (
        score.name, one.program, f"{score.distance:.1f}", f"{100.0 * score.covered:.0f}", f"{score.along_final:+.2f}",
        _cell(score.drift), f"{score.along_rms:.3f}", f"{score.across_rms:.3f}", f"{score.up_rms:.3f}",
        _cell(score.piece_along), _cell(score.piece_across), _cell(score.piece_turn, 3), f"{score.ape.rmse:.3f}",
        _cell(None if score.rpe is None else score.rpe.rmse, 3),
    )  # fmt: skip


def _cell(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


_PANELS = (("along the axis", 0), ("across it", 1))
_STYLES = ("-", "--", ":", "-.")


def draw(scores: list[ProgramScore]) -> Figure:
    """Draws errors against distance: a colour for each program, a line style for each recording."""
    programs, names = (list(dict.fromkeys(values)) for values in zip(*((j.program, j.score.name) for j in scores),
                                                                     strict=True))  # fmt: skip
    figure, panels = plt.subplots(2, 1, figsize=(8.0, 6.0), sharex=True, layout="constrained")
    colours = plt.get_cmap("tab10")
    for axes, (title, part) in zip(panels, _PANELS, strict=True):
        for one in scores:
            style = _STYLES[names.index(one.score.name) % len(_STYLES)]
            axes.plot(
                one.curve.travelled, one.curve.error[:, part], style, color=colours(programs.index(one.program)),
                lw=1.4, label=f"{one.program}, {one.score.name}",
            )  # fmt: skip
        axes.axhline(0.0, color="0.6", lw=0.8, zorder=0)
        axes.set_ylabel(f"error {title}, m")
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("distance driven, m")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def as_png(scores: list[ProgramScore]) -> bytes:
    """Return the figure as a PNG file."""
    figure, buffer = draw(scores), io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    plt.close(figure)
    return buffer.getvalue()
