"""The figures of a report; a figure whose material is missing is left out with its reason."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.curve import candidate_curve, cast_profile
from benchmarks.fidelity.derive.distances import VOXEL_EDGE, Occupied, occupied_voxels
from benchmarks.fidelity.derive.sections import truth_bore_caster
from benchmarks.fidelity.table import Need
from benchmarks.fidelity.windows.deviation import CELL, Unrolled, bore_caster
from benchmarks.fidelity.windows.judge import Source, unrolled

matplotlib.use("Agg")


@dataclass(frozen=True)
class Sheet:
    """Material of all figures."""

    case: Case  # Case of the reconstruction
    report: dict[str, Any]  # Content of the report

    def note(self, n: int | None = None) -> str:
        hold = self.report["split"]["hold"]
        split = (f"held out: {hold['file']}" if hold["file"] else "held-out beams") if hold else "nothing held out"
        count = "" if n is None else f" n = {n:,}."
        return f"{count} Seed {self.report['seed']}; {split}; split {self.report['split']['rule']}."


Drawn = tuple[Figure, str]
Draw = Callable[[Sheet], Drawn | None]
INK, BLUE, RED = "#1b1b1b", "#0072b2", "#d55e00"
AGREE, ONLY_MESH, ONLY_CLOUD = "#009e73", "#d55e00", "#0072b2"  # the paper's green, red and blue, for all eyes
CLASSES = ListedColormap([AGREE, ONLY_MESH, ONLY_CLOUD])  # of a map of agreement
DIVERGING = LinearSegmentedColormap.from_list("error", ["#0072b2", "#f7f7f7", "#d55e00"])
_LIMIT = 5.0  # cm
_TURN = (-180, -90, 0, 90, 180)  # deg


def show_map(axes: plt.Axes, values: Float[np.ndarray, "n m"], extent: Any, **style: Any) -> AxesImage:
    """Draws a map with the tunnel along x, as it is: no cell is blended with another."""
    style = {"aspect": "auto", "interpolation": "nearest"} | style
    return axes.imshow(values.T, origin="lower", extent=extent, **style)


# Voxels of the bore's shell, and the voxels in which cloud and mesh disagree (the paper's Fig. 3).


_ALONG = "along the sensor's path, m"
_PLANES = ((_ALONG, "left, m", 2), (_ALONG, "up, m", 1), ("left, m", "up, m", 0))


def draw_projections(sheet: Sheet) -> Drawn:
    grids, edge = occupied_voxels(sheet.case), VOXEL_EDGE
    low = _low_corner(sheet, grids)
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained", width_ratios=(3, 3, 1.4))
    for axis, (x, y, along) in zip(axes, _PLANES, strict=True):
        total = grids.first.sum(axis=along).astype(float)
        rest = [k for k in range(3) if k != along]
        picture = show_map(axis, np.where(total > 0, total, np.nan), _extent(low[rest], edge, total.shape),
                           cmap="viridis", norm=LogNorm(1), aspect="equal" if along == 0 else "auto")  # fmt: skip
        axis.set(xlabel=x, ylabel=y)
        figure.colorbar(picture, ax=axis, shrink=0.8, label="voxels" if along == 0 else None)
    axes[2].invert_xaxis()  # left is drawn left
    caption = f"Occupied voxels of {edge * 100:.0f} cm of the bore's shell, summed along the third axis."
    return figure, caption + sheet.note(int(grids.first.sum()))


def draw_mismatch(sheet: Sheet) -> Drawn:
    grids, edge = occupied_voxels(sheet.case), VOXEL_EDGE
    low = _low_corner(sheet, grids)
    figure, (side, unrolled) = plt.subplots(2, 1, figsize=(12, 5.4), layout="constrained", sharex=True)
    flat = _agreement_classes(np.asarray(grids.real.any(axis=1)), np.asarray(grids.first.any(axis=1)))
    rolled = _unroll_classes(grids, low, edge)
    end = low[0] + edge * rolled.shape[0]
    show_map(side, flat, _extent(low[[0, 2]], edge, flat.shape), cmap=CLASSES, vmin=0, vmax=2)
    show_map(unrolled, rolled, (low[0], end, -180, 180), cmap=CLASSES, vmin=0, vmax=2)
    side.set(ylabel="up, m")
    unrolled.set(ylabel="angle from left\ntowards up, deg", xlabel=_ALONG, yticks=_TURN)
    names = ("both", "mesh only", "held-out cloud only")
    patches = [Patch(color=CLASSES(k), label=name) for k, name in enumerate(names)]
    side.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, 1.22), ncol=3, frameon=False)
    both, either = int((grids.real & grids.first).sum()), int((grids.real | grids.first).sum())
    caption = f"Voxels of {edge * 100:.0f} cm: from the side and unrolled. {both / max(either, 1):.1%} agree."
    return figure, caption + sheet.note(either)


def _extent(low: np.ndarray, edge: float, shape: tuple[int, ...]) -> tuple[float, float, float, float]:
    return low[0], low[0] + edge * shape[0], low[1], low[1] + edge * shape[1]


def _low_corner(sheet: Sheet, grids: Occupied) -> np.ndarray:
    """Return the low corner of the grid: station, left, up, m."""
    real, edge = returns(sheet.case), VOXEL_EDGE
    low = [grids.station[0] - 0.5 * edge]
    first = np.argwhere(grids.real).min(axis=0)
    return np.array(low + [edge * (np.floor(real.local[:, k].min() / edge) - first[k]) for k in (1, 2)])


def _agreement_classes(real: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """Return 0 for both, 1 for the mesh alone, 2 for the cloud alone, NaN for neither."""
    return np.where(real & mesh, 0.0, np.where(mesh, 1.0, np.where(real, 2.0, np.nan)))


def _unroll_classes(grids: Occupied, low: np.ndarray, edge: float, sectors: int = 90) -> np.ndarray:
    real, mesh = (np.zeros((grids.real.shape[0], sectors), bool) for _ in range(2))
    middle = np.median(low[1:] + edge * (np.argwhere(grids.real)[:, 1:] + 0.5), axis=0)
    for target, grid in ((real, grids.real), (mesh, grids.first)):
        index = np.argwhere(grid)
        place = low[1:] + edge * (index[:, 1:] + 0.5)
        angle = np.arctan2(place[:, 1] - middle[1], place[:, 0] - middle[0])
        target[index[:, 0], np.floor((angle + np.pi) / (2 * np.pi) * sectors).astype(int) % sectors] = True
    return _agreement_classes(real, mesh)


# The worst windows: the unrolled map of deviations, and the three worst places.

_PLACES = 3
_NEAR = 0.25  # m of recording to either side of a place
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
    axes.set(xlabel="station, m", yticks=_TURN, yticklabels=("right", "floor", "left", "crown", "right"))
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
        near = np.abs(local[:, 0] - station) < _NEAR
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


FIGURES: tuple[tuple[str, Draw, Need | None], ...] = (  # with the reference that each cannot do without
    ("unrolled", draw_unrolled, "reference"),
    ("worst-places", draw_worst_places, "reference"),
    ("voxels", draw_projections, "hold"),
    ("mismatch", draw_mismatch, "hold"),
)


def draw_all(folder: Path, sheet: Sheet) -> dict[str, tuple[Path, str]]:
    """Writes each figure; returns its PNG file and caption by name, in order."""
    folder.mkdir(parents=True, exist_ok=True)
    written = {}
    with plt.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        for name, draw, need in FIGURES:
            if not sheet.case.has(need):
                continue
            try:
                drawn = draw(sheet)
            except Exception as error:  # a recording that shows too little costs its own figure
                print(f"{name} is left out: {error}", flush=True)
                plt.close("all")
                continue
            if drawn is None:
                continue
            figure, caption = drawn
            written[name] = (folder / f"{name}.png", caption)
            figure.savefig(written[name][0], dpi=130)
            plt.close(figure)
    return written
