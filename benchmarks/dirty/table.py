"""Rows of results as Markdown and JSON."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

_HEAD = (
    "case", "verdict", "walls mean, cm", "within 10 cm, %", "p99, cm", "width, cm", "height, cm", "floor, cm",
    "from, to, m", "sleepers seen", "gauge, m", "s", "GiB", "what is wrong, or said",
)  # fmt: skip


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """Return one table with a line for each case, and one by kind.

    Sizes are median / worst errors; the worst is of a running median over 1.5 m.
    """
    lines = [_line(_HEAD), "|" + "---|" * len(_HEAD), *(_line(_cells(row)) for row in rows)]
    return "\n".join([*lines, "", *_by_kind(rows), ""])


def _line(cells: tuple[str, ...] | list[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _cells(row: dict[str, Any]) -> list[str]:
    said = "; ".join(row.get("faults") or []) or row["message"]
    warnings = " ".join(f"[{text}]" for text in row["warnings"])
    track = row.get("sleepers_seen")
    return [
        row["name"], row["verdict"], _number(row, "wall_mean", 100, 2), _number(row, "wall_near", 100, 2),
        _number(row, "wall_p99", 100, 1), *(_pair(row, name) for name in ("width", "height", "floor")),
        f"{row['from']:.2f}, {row['to']:.2f}" if "from" in row else "",
        "" if track is None else f"{track} of {row['sleepers']}", _number(row, "gauge_seen", 1, 4),
        f"{row['seconds']:.0f}", f"{row['memory']:.2f}", f"{said} {warnings}".strip(),
    ]  # fmt: skip


def _number(row: dict[str, Any], name: str, scale: float, digits: int) -> str:
    value = row.get(name)
    return "" if value is None or math.isnan(value) else f"{scale * value:.{digits}f}"


def _pair(row: dict[str, Any], name: str) -> str:
    values = [_number(row, key, 100, 1) for key in (name, f"{name}_worst")]
    return " / ".join(values) if values[0] else ""


def _by_kind(rows: list[dict[str, Any]]) -> list[str]:
    head = ("kind", "cases", "built", "walls ≤ 3 cm", "verdicts", "reasons of refusals")
    kinds = dict.fromkeys(row["kind"] for row in rows)
    lines = [_line(_kind_cells(kind, [row for row in rows if row["kind"] == kind])) for kind in kinds]
    return [_line(head), "|" + "---|" * len(head), *lines, _line(_kind_cells("all", rows))]


def _kind_cells(kind: str, rows: list[dict[str, Any]]) -> list[str]:
    def count(hit: Callable[[dict[str, Any]], bool]) -> int:
        return sum(hit(row) for row in rows)

    built = count(lambda row: row["status"] == 0)
    close = count(lambda row: row.get("wall_mean", math.inf) <= 0.03)
    verdicts = Counter(row["verdict"] for row in rows)
    reasons = Counter(row["message"].rsplit(": ", 1)[-1] for row in rows if row["status"])
    told = "; ".join(f"{number} times {text}" for text, number in reasons.most_common(4))
    summed = ", ".join(f"{number} {name}" for name, number in verdicts.most_common())
    return [kind, str(len(rows)), str(built), f"{close} ({100 * close / max(len(rows), 1):.0f} %)", summed, told]
