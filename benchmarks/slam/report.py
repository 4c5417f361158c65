"""Scores as a table and as JSON."""

import json
from typing import Any

from benchmarks.slam.judge import Judged
from benchmarks.slam.score import SCHEMA

_HEAD = (
    "recording", "program", "driven, m", "covered %", "along at the end, m", "drift %", "along, m", "across, m",
    "up, m", "along % of pieces", "across % of pieces", "turn, °/m", "APE, m", "RPE, m",
)  # fmt: skip


def as_rows(found: list[Judged]) -> list[tuple[str, ...]]:
    """The table's cells, its head first."""
    return [_HEAD, *(_row(one) for one in sorted(found, key=lambda one: (one.score.name, one.program)))]


def as_markdown(found: list[Judged]) -> str:
    """The table for a page, and what its columns mean."""
    rows = [f"| {' | '.join(row)} |" for row in as_rows(found)]
    first = found[0].score
    note = (
        f"Root mean squares over the recording, alignment `{first.alignment}`. Pieces are {first.piece:g} m of path: "
        "RMS error of their motion in % of it. APE and RPE are root mean squares as `evo` defines them."
    )
    return "\n".join([rows[0], "|" + "---|" * len(_HEAD), *rows[1:], "", note, ""])


def as_json(found: list[Judged], facts: dict[str, Any]) -> str:
    """Everything, for programs."""
    scores = [{"program": one.program, **one.score.as_dict()} for one in found]
    return json.dumps({"schema": SCHEMA, **facts, "scores": scores}, indent=1, default=str) + "\n"


def _row(one: Judged) -> tuple[str, ...]:
    score = one.score
    return (
        score.name, one.program, f"{score.distance:.1f}", f"{100.0 * score.covered:.0f}", f"{score.along_final:+.2f}",
        _cell(score.drift), f"{score.along_rms:.3f}", f"{score.across_rms:.3f}", f"{score.up_rms:.3f}",
        _cell(score.piece_along), _cell(score.piece_across), _cell(score.piece_turn, 3), f"{score.ape.rmse:.3f}",
        _cell(None if score.rpe is None else score.rpe.rmse, 3),
    )  # fmt: skip


def _cell(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"
