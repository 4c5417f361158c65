"""Figures of the worst windows: the unrolled map of deviations, and the three worst places."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import candidate_curve, cast_profile
from benchmarks.fidelity.derive.sections import truth_bore_caster
from benchmarks.fidelity.figures.sheet import BLUE, DIVERGING, INK, RED, Drawn, Sheet
from benchmarks.fidelity.windows.deviation import CELL, Unrolled, bore_caster
from benchmarks.fidelity.windows.measures import Source, unrolled

_LIMIT = 5.0  # cm
_PLACES = 3
_SLICE = 0.25  # m of recording to either side of a place
_APART = 5.0  # m between two places
_LINES = {"gauge": 1000.0, "gauge_change": 1000.0}  # what is written in mm


def worst_places(sheet: Sheet) -> list[dict]:
    """Return the windows nearest to their limits or farthest beyond, no two of the same stretch."""
    rows = [row for row in sheet.report["windows"]["worst"] if row["value"] is not None and row["id"] != "hand"]
    places: list[dict] = []
    for row in sorted(rows, key=lambda row: -row["value"] / row["limit"]):
        middle = (row["start"] + row["end"]) / 2
        if all(abs(middle - (one["start"] + one["end"]) / 2) > _APART for one in places):
            places.append(row)
    return places[:_PLACES]


def draw_unrolled(sheet: Sheet) -> Drawn:
    source: Source = "truth" if sheet.case.truth is not None else "recording"
    one = unrolled(sheet.case, source)
    station = _stations(sheet.case, one)
    figure, axes = plt.subplots(figsize=(12, 3.8), layout="constrained")
    edges = np.degrees(np.linspace(-np.pi, np.pi, one.offset.shape[1] + 1))
    picture = axes.pcolormesh(
        station, edges, 100.0 * one.offset.T, cmap=DIVERGING, vmin=-_LIMIT, vmax=_LIMIT, rasterized=True
    )
    axes.set_facecolor("0.8")
    for number, row in enumerate(worst_places(sheet), 1):
        color = RED if row["beyond"] else INK
        axes.axvspan(row["start"], row["end"], fill=False, ec=color, lw=1.5)
        axes.text(row["start"] + 0.2, 150, str(number), color=color, fontweight="bold")
    axes.set(
        xlabel="station, m",
        yticks=(-180, -90, 0, 90, 180),
        yticklabels=("right", "floor", "left", "crown", "right"),
    )
    figure.colorbar(picture, label="candidate beyond\nthe reference, cm", extend="both")
    known = int(np.isfinite(one.offset).sum())
    caption = (
        f"Unrolled map of deviations against the {source}: medians of {CELL:g} m by 5 degrees; grey is not seen; boxes "
        "are the windows nearest to their limits, red where beyond."
    )
    return figure, caption + sheet.note(known)


def draw_worst_places(sheet: Sheet) -> Drawn | None:
    places = worst_places(sheet)
    if not places:
        return None
    figure, panels = plt.subplots(1, len(places), figsize=(4 * len(places), 4.6), layout="constrained", squeeze=False)
    for number, (axes, row) in enumerate(zip(panels[0], places, strict=True), 1):
        _draw_section(axes, sheet.case, (row["start"] + row["end"]) / 2)
        factor = _LINES.get(row["id"], 100.0 if row["unit"] == "m" else 1.0)
        unit = "mm" if row["id"] in _LINES else "cm" if row["unit"] == "m" else ""
        axes.set_title(
            f"{number}: {row['words']}{' at the ' + row['where'] if row['where'] else ''}\n"
            f"{factor * row['value']:.2g} {unit} (limit {factor * row['limit']:.2g}), "
            f"station {row['start']:.0f} to {row['end']:.0f} m, {row['source']}",
            fontsize=8, color=RED if row["beyond"] else INK,
        )  # fmt: skip
    caption = "Sections in the middle of the worst windows: candidate (line), truth (dashed), held-out returns (dots)."
    return figure, caption + sheet.note()


def _draw_section(axes: plt.Axes, case: Case, station: float) -> None:
    bore = case.candidate.bore
    curve = candidate_curve(case)
    if case.hold is not None:
        local = curve.local(case.hold.points)
        near = np.abs(local[:, 0] - station) < _SLICE
        axes.plot(local[near, 1], local[near, 2], ".", ms=1.5, color=BLUE, alpha=0.5)
    angle = np.append(bore.angle, bore.angle[0])
    lines = [(bore_caster, "-", RED)] + ([(truth_bore_caster, "--", INK)] if case.truth is not None else [])
    for caster, style, color in lines:
        radius = cast_profile(caster(case), curve, np.array([station]), angle)[0]
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), style, lw=1.2, color=color)
    axes.set(aspect="equal", xlabel="left, m")
    axes.invert_xaxis()


def _stations(case: Case, one: Unrolled) -> np.ndarray:
    """Return the edges of the map's rows as stations of the candidate, m."""
    edges = one.low + CELL * np.arange(len(one.offset) + 1)
    local = np.column_stack([edges, np.full_like(edges, one.middle[0]), np.full_like(edges, one.middle[1])])
    return candidate_curve(case).local(one.curve.point(local))[:, 0]
