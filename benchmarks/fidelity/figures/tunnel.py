"""Figures of the tunnel: axis, beams, degeneracy, free space, persistence, worst windows."""

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.axis import reference_curve
from benchmarks.fidelity.derive.beams import cast_beams, noisy_ranges, returns
from benchmarks.fidelity.derive.clouds import plane_rows, real_planes, synthetic_planes
from benchmarks.fidelity.derive.curve import candidate_curve, cast_profile
from benchmarks.fidelity.derive.degeneracy import information
from benchmarks.fidelity.derive.mesh import candidate_diagrams, reference_diagrams
from benchmarks.fidelity.derive.plane import free_plane
from benchmarks.fidelity.derive.sections import truth_bore_caster
from benchmarks.fidelity.figures.sheet import (
    BLUE,
    CLASSES,
    DIVERGING,
    GREY,
    INK,
    ORANGE,
    RED,
    Drawn,
    Sheet,
    legend_classes,
    show_map,
)  # fmt: skip  # isort: skip
from benchmarks.fidelity.windows.deviation import CELL, Unrolled, bore_caster
from benchmarks.fidelity.windows.measures import Source, unrolled


def draw_axis(sheet: Sheet) -> Drawn:
    ours, reference = candidate_curve(sheet.case), reference_curve(sheet.case)
    start, chord = reference.position[0], reference.position[-1] - reference.position[0]
    chord = chord[:2] / np.linalg.norm(chord[:2])
    turn = np.array([chord, [-chord[1], chord[0]]])
    figure, (plan, profile, offset) = plt.subplots(3, 1, figsize=(11, 7), layout="constrained")
    for curve, colour, label, style in ((reference, INK, "reference", "-"), (ours, BLUE, "reconstruction", "--")):
        along, across = turn @ (curve.position[:, :2] - start[:2]).T
        plan.plot(along, across, style, color=colour, label=label)
        profile.plot(along, curve.position[:, 2] - start[2], style, color=colour)
    ends = reference.position[[0, -1]]
    plan.plot(*(turn @ (ends[:, :2] - start[:2]).T), "^", color=ORANGE, label="ends of the reference")
    local = reference.local(ours.position)
    offset.plot(local[:, 0], 100 * local[:, 1], color=BLUE, label="left")
    offset.plot(local[:, 0], 100 * local[:, 2], color=ORANGE, label="up")
    plan.set(ylabel="across, m")
    profile.set(ylabel="height, m", xlabel="along the chord, m")
    offset.set(xlabel="station, m", ylabel="offset from the\nreference, cm")
    plan.legend(frameon=False, ncol=3)
    offset.legend(frameon=False, ncol=2)
    caption = "Centrelines in plan and profile, and the reconstruction's offset from the reference; no alignment."
    return figure, caption + sheet.note(len(ours.station))


# Beams: recorded, and cast in the candidate.


def draw_range_image(sheet: Sheet) -> Drawn:
    real, cast = returns(sheet.case), cast_beams(sheet.case)
    scans = np.unique(real.scan)
    rows = real.scan == scans[len(scans) // 2]
    turn = np.degrees(np.arctan2(real.heading[rows, 1], real.heading[rows, 0]))
    rise = np.degrees(np.arcsin(np.clip(real.heading[rows, 2], -1, 1)))
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained", sharey=True)
    span = dict(vmin=0, vmax=float(np.percentile(real.range[rows], 98)), cmap="viridis")
    in_candidate = np.where(cast.hit, cast.range, np.nan)
    pictures = (("recorded", real.range[rows], span), ("in the reconstruction", in_candidate[rows], span),
                ("difference", 100 * cast.difference[rows], dict(vmin=-20, vmax=20, cmap=DIVERGING)))  # fmt: skip
    for axis, (name, values, style) in zip(axes, pictures, strict=True):
        shown = axis.scatter(turn, rise, c=values, s=2.5, lw=0, rasterized=True, **style)
        axis.set(title=name, xlabel="azimuth from the axis, deg")
        figure.colorbar(shown, ax=axis, label="cm" if name == "difference" else "m")
    axes[0].set(ylabel="elevation, deg")
    caption = f"Scan {int(scans[len(scans) // 2])} of the held-out recording and the same beams cast."
    return figure, caption + sheet.note(int(rows.sum()))


def draw_sensor_distributions(sheet: Sheet) -> Drawn:
    real, synthetic = returns(sheet.case), noisy_ranges(sheet.case, "first")
    by = {entry["id"]: entry["value"] for entry in sheet.report["metrics"]}
    figure, (ranges, incidence, elevation) = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained")
    top = float(np.percentile(real.range, 99.5))
    for values, colour, label in (
        (real.range, BLUE, "recorded"),
        (synthetic[np.isfinite(synthetic)], ORANGE, "in the reconstruction"),
    ):
        ranges.hist(np.clip(values, 0, top), bins=120, density=True, histtype="step", color=colour, label=label)
    title = _statistics_title({"KS": by["range_ks"], "W1": by["range_w1"]}, "m")
    ranges.set(xlabel="range, m", ylabel="density, 1/m", title=title)
    ranges.legend(frameon=False)
    direction = real.direction[plane_rows(sheet.case)]
    for planes, colour in ((real_planes(sheet.case), BLUE), (synthetic_planes(sheet.case), ORANGE)):
        angle = np.degrees(np.arccos(np.clip(np.abs(np.einsum("ij,ij->i", direction, planes.normal)), 0, 1)))
        incidence.hist(angle[np.isfinite(angle)], bins=60, density=True, histtype="step", color=colour)
    title = _statistics_title({"W1": by["incidence_w1"]}, "deg")
    incidence.set(xlabel="incidence, deg", ylabel="density, 1/deg", title=title)
    rise = np.degrees(np.arcsin(np.clip(real.heading[:, 2], -1, 1)))
    edges = np.linspace(rise.min(), rise.max() + 1e-6, 25)
    group = np.digitize(rise, edges) - 1
    for values, colour in ((real.range, BLUE), (synthetic, ORANGE)):
        medians = [np.median(v) if len(v := values[(group == k) & np.isfinite(values)]) else np.nan for k in range(24)]
        elevation.step(edges[:-1], medians, where="post", color=colour)
    title = _statistics_title({"W1": by["elevation_w1"]}, "m")
    elevation.set(xlabel="elevation, deg", ylabel="median range, m", title=title)
    return figure, "Distributions of held-out beams, recorded and cast with range noise." + sheet.note(len(real.range))


def _statistics_title(values: dict[str, float | None], unit: str) -> str:
    parts = [f"{name} {value:.3g}" for name, value in values.items() if value is not None]
    return ", ".join(parts) + (f" {unit}" if parts else "")


def draw_degeneracy(sheet: Sheet) -> Drawn:
    frames = (
        (information(sheet.case, True), BLUE, "recorded"),
        (information(sheet.case, False), ORANGE, "in the reconstruction"),
        (information(sheet.null, False), GREY, "in the null tube"),
    )
    figure, (axial, strong) = plt.subplots(2, 1, figsize=(12, 4.6), layout="constrained", sharex=True)
    for scans, colour, label in frames:
        order = np.argsort(scans.station)
        axial.plot(scans.station[order], scans.axial[order], color=colour, lw=1.2, label=label)
        strong.plot(scans.station[order], 100 * scans.strong[order], color=colour, lw=1.2)
    axial.set(ylabel="axial information a point", yscale="log")
    axial.legend(frameon=False, ncol=3, loc="upper center", bbox_to_anchor=(0.5, 1.22))
    strong.set(xlabel="station, m", ylabel="points whose normal lies\nwithin 60° of the axis, %", ylim=(0, None))
    count = len(frames[0][0].station)
    return figure, "Axial share of the point-to-plane Hessian of each held-out scan." + sheet.note(count)


def draw_free_space(sheet: Sheet) -> Drawn:
    plane = free_plane(sheet.case)
    lattice, edge = plane.lattice, plane.lattice.edge
    only = np.where(plane.judged, 1.0, np.where(plane.reference, 2.0, np.nan))
    classes = np.where(plane.known, np.where(plane.judged & plane.reference, 0.0, only), np.nan)
    left = lattice.low[1] + edge * (np.arange(lattice.shape[1]) + 0.5)
    ends = [low + edge * n for low, shape in zip(lattice.low[:2], lattice.shape, strict=False) for n in (0, shape)]
    figure, (map_axis, room) = plt.subplots(2, 1, figsize=(12, 5), layout="constrained", sharex=True)
    show_map(map_axis, classes, ends, cmap=CLASSES, vmin=0, vmax=2, alpha=0.55)
    for free, colour, label in ((plane.reference, INK, "reference"), (plane.judged, BLUE, "reconstruction")):
        clearance = distance_transform_edt(np.pad(free, ((0, 0), (1, 1))))[:, 1:-1] * edge
        map_axis.plot(plane.station, left[np.argmax(clearance, axis=1)], color=colour, lw=1)
        room.plot(plane.station, clearance.max(axis=1), color=colour, lw=1.2, label=label)
    names = ("free in both", "free in the reconstruction only", "free in the reference only")
    legend_classes(map_axis, names, alpha=0.55)
    map_axis.set(ylabel="left, m")
    room.set(xlabel="station, m", ylabel="largest clearance, m", ylim=(0, 1.1 * room.dataLim.y1))
    room.legend(frameon=False, loc="lower right")
    caption = f"Free cells of {edge * 100:.0f} cm at sensor height, places of most clearance (lines), and how much."
    return figure, caption + sheet.note(int(plane.known.sum()))


_DIAGRAMS = ("components", "loops", "voids")


def draw_persistence(sheet: Sheet) -> Drawn:
    ours, reference = candidate_diagrams(sheet.case), reference_diagrams(sheet.case)
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained")
    count = 0
    for axis, name, mine, theirs in zip(axes, _DIAGRAMS, ours, reference, strict=True):
        for pairs, colour, mark, label in ((theirs, ORANGE, "o", "reference"), (mine, BLUE, "x", "reconstruction")):
            pairs = np.nan_to_num(np.asarray(pairs, float).reshape(-1, 2), posinf=0.0, neginf=0.0)
            count += len(pairs)
            axis.plot(pairs[:, 0], pairs[:, 1], mark, color=colour, ms=5, mfc="none", label=label)
        if not len(mine) and not len(theirs):
            axis.text(0.5, 0.5, "none in either", transform=axis.transAxes, ha="center", color=GREY)
            axis.set(xlim=(-1, 0), ylim=(-1, 0))
        low, high = min(axis.get_xlim()[0], axis.get_ylim()[0]), max(axis.get_xlim()[1], axis.get_ylim()[1])
        axis.plot([low, high], [low, high], color=GREY, lw=0.8)
        axis.set(title=name, xlabel="clearance at birth, m", aspect="equal")
    axes[0].set(ylabel="clearance at death, m")
    axes[0].legend(frameon=False)
    caption = "Persistence of free space as the clearance asked falls; far from the diagonal is what lasts."
    return figure, caption + sheet.note(count)


# The worst windows: the unrolled map of deviations, and the three worst places.

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
