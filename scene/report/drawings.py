"""Drawings for CAD (DXF) and pictures of deviations, clearance and the fitted alignment (PNG, TIFF)."""

from pathlib import Path

import ezdxf
import matplotlib.pyplot as plt
import numpy as np
import tifffile
from ezdxf.document import Drawing
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from scene.bore import Bore
from scene.report.alignment import AlignmentFit
from scene.report.sections import DesignSection, at_round_chainages, nearest_rows

_LAYERS = {"MEASURED": 5, "DESIGN": 3, "AXIS": 1, "TEXT": 7, "GRID": 8}
_TEXT = 0.25  # height of text, m
_BELOW = 20.0  # m from the plan down to the profile
_PAD = 2.0  # m between two sections in a drawing


def _drawing() -> Drawing:
    document = ezdxf.new("R2010", setup=True)
    document.units = ezdxf.units.M
    for name, colour in _LAYERS.items():
        document.layers.add(name, color=colour)
    return document


def write_sections(
    path: Path, bore: Bore, design: DesignSection, chainage: Float[np.ndarray, " n"], every: float = 10.0
) -> int:
    """Write sections as measured and as designed, side by side, looking towards growing stations; returns their number.

    Args:
        path: The DXF file.
        bore: The bore.
        design: The section that was to be built.
        chainage: Chainage of each station, m.
        every: Distance from section to section, m of chainage; the first stands at a multiple of it.
    """
    document = _drawing()
    space = document.modelspace()
    wanted = at_round_chainages(bore, chainage, every)
    rows = nearest_rows(bore, wanted)
    pitch = np.array([float(bore.width.max()) + _PAD, float(bore.height.max()) + 2.0 * _PAD])
    across = max(1, int(np.ceil(np.sqrt(len(rows)))))
    for k, row in enumerate(rows):
        middle = pitch * [k % across, -(k // across)]
        for layer, radius in (("MEASURED", bore.radius[row]), ("DESIGN", design.radius[row])):
            # Looking ahead the left is on the left.
            points = np.column_stack([-radius * np.cos(bore.angle), radius * np.sin(bore.angle)]) + middle
            space.add_lwpolyline(points.tolist(), close=True, dxfattribs={"layer": layer})
        for end in ((0.3, 0.0), (0.0, 0.3)):
            space.add_line(middle - end, middle + end, dxfattribs={"layer": "AXIS"})
        at = np.interp(wanted[k], bore.station, chainage)
        label = space.add_text(f"{at:.2f}", height=_TEXT, dxfattribs={"layer": "TEXT"})
        label.set_placement(middle - [0.0, 0.5 * pitch[1] - 0.5], align=ezdxf.enums.TextEntityAlignment.MIDDLE_CENTER)
    document.saveas(path)
    return len(rows)


def write_plan_profile(
    path: Path, bore: Bore, origin: Float[np.ndarray, "3"], chainage: Float[np.ndarray, " n"]
) -> None:
    """Write the plan with walls in the input's frame, and below it the profile, heights ten times as large."""
    document = _drawing()
    space = document.modelspace()
    plan = bore.position[:, :2] + origin[:2]
    half = 0.5 * bore.width[:, None] * bore.lateral[:, :2]
    for layer, line in (("AXIS", plan), ("MEASURED", plan + half), ("MEASURED", plan - half)):
        space.add_lwpolyline(line.tolist(), dxfattribs={"layer": layer})
    wanted = at_round_chainages(bore, chainage, 20.0)
    names = [f"{value:.0f}" for value in np.interp(wanted, bore.station, chainage)]
    frame = bore.axis.at(wanted)
    sides = (0.5 * bore.width[nearest_rows(bore, wanted), None] * frame.lateral)[:, :2]
    for name, place, side in zip(names, frame.position[:, :2] + origin[:2], sides, strict=True):
        space.add_line(place - side, place + side, dxfattribs={"layer": "GRID"})
        _write_label(space, name, place + 1.3 * side)
    down, up = (int(np.argmin(np.abs(bore.angle - angle))) for angle in (-np.pi / 2, np.pi / 2))
    axis = bore.position[:, 2]
    lines = (axis, axis - bore.radius[:, down] * bore.up[:, 2], axis + bore.radius[:, up] * bore.up[:, 2])
    least = float(lines[1].min())
    corner = plan.min(axis=0) - [0.0, 10.0 * (float(lines[2].max()) - least) + _BELOW]
    for layer, line in zip(("AXIS", "MEASURED", "MEASURED"), lines, strict=True):
        points = corner + np.column_stack([bore.station, 10.0 * (line - least)])
        space.add_lwpolyline(points.tolist(), dxfattribs={"layer": layer})
    for name, station in zip(names, wanted, strict=True):
        _write_label(space, name, np.add(corner, [station, -2.0]))
    _write_label(space, f"profile, heights x 10, from {least + origin[2]:.2f} m", np.add(corner, [0.0, -5.0]))
    document.saveas(path)


def _write_label(space: ezdxf.layouts.Modelspace, text: str, place: Float[np.ndarray, "2"]) -> None:
    space.add_text(text, height=4.0 * _TEXT, dxfattribs={"layer": "TEXT"}).set_placement(tuple(place))


def deviation(bore: Bore, design: DesignSection) -> Float[np.ndarray, "n m"]:
    """Return how far the wall lies outside the design at each station and angle, m; NaN where it was filled in."""
    return np.where(bore.filled[:, None], np.nan, bore.radius - design.radius)


def write_unrolled(
    folder: Path, bore: Bore, design: DesignSection, chainage: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    """Write `unrolled.tif` (float32, m, a row a station step, a column an angle from the floor around) and its picture.

    Returns the sizes of a pixel: along the bore and, at the mean radius, around it, m. A ring survey leaves most of
    the wall between rings filled in: there the map has NaN, and the picture shows grey. A flaring mouth, metres wide,
    does not set the picture's scale: its colours end at three times what nine tenths of the wall keep.
    """
    floor = int(np.argmin(np.abs(bore.angle + np.pi / 2)))
    field = np.roll(deviation(bore, design), -floor, axis=1).astype(np.float32)
    tifffile.imwrite(folder / "unrolled.tif", field, compression="zlib", metadata=None, software="Subterra")
    seen = np.abs(field[np.isfinite(field)])
    tenth, most = np.quantile(seen, [0.9, 0.99]) if len(seen) else (0.0, 0.0)
    limit = max(0.005, float(min(most, 3.0 * tenth)))
    rows = max(1, int(np.ceil(bore.length / 200.0)))
    figure, axes = plt.subplots(rows, 1, figsize=(11, 2.0 * rows + 1.0), squeeze=False, layout="constrained")
    around = bore.radius.mean() * 2.0 * np.pi
    names = ["floor", "left", "crown", "right", "floor"]
    for k, one in enumerate(axes[:, 0]):
        inside = (bore.station >= 200.0 * k) & (bore.station <= 200.0 * (k + 1))
        one.axvspan(bore.station[inside][0], bore.station[inside][-1], color="0.85", zorder=-1)
        extent = (bore.station[inside][0], bore.station[inside][-1], 0.0, around)
        image = one.imshow(field[inside].T, origin="lower", aspect="auto", extent=extent, cmap="RdBu_r", vmin=-limit,
                           vmax=limit, interpolation="nearest")  # fmt: skip
        inside_rings = bore.ring_station[(bore.ring_station >= extent[0]) & (bore.ring_station <= extent[1])]
        one.vlines(inside_rings, 0.0, 0.02 * around, color="k", lw=0.4)
        one.set_xlim(200.0 * k, min(200.0 * (k + 1), bore.length) if rows == 1 else 200.0 * (k + 1))
        one.set_yticks(np.linspace(0.0, around, 5), names)
        _mark_chainages(one, bore.station[inside], chainage[inside])
    axes[-1, 0].set_xlabel("chainage, m")
    figure.colorbar(image, ax=axes, label="outside (+) or\ninside (-) the design, m", shrink=0.9, extend="both")
    _save(figure, folder / "unrolled.png")
    return float(bore.station[1] - bore.station[0]), around / field.shape[1]


def _mark_chainages(one: Axes, along: np.ndarray, chainage: np.ndarray) -> None:
    """Label the places `along` a picture with round chainages, which may fall from left to right."""
    way = 1.0 if chainage[-1] > chainage[0] else -1.0
    low, high = np.sort(chainage[[0, -1]])
    # A stretch that fills a part of the picture has room for fewer.
    room = max(1, round(9.0 * min(1.0, (along[-1] - along[0]) / np.diff(one.get_xlim())[0])))
    marks = MaxNLocator(room, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    marks = marks[(marks >= low - 1e-6) & (marks <= high + 1e-6)]
    one.set_xticks(np.interp(way * marks, way * chainage, along), [f"{mark:g}" for mark in marks])


def draw_alignment(path: Path, bore: Bore, fit: AlignmentFit, chainage: Float[np.ndarray, " n"]) -> None:
    """Draw curvature and grade of the fitted elements, and what they leave of the axis, over chainage."""
    figure, axes = plt.subplots(4, 1, figsize=(11, 8), sharex=True, layout="constrained")
    for one, label, scale, part in (
        (axes[0], "curvature, 1/km", 1e3, fit.plan),
        (axes[2], "grade, %", 1e2, fit.profile),
    ):
        one.plot(part.profile.knot, scale * part.profile.value, "k.-", lw=1)
        one.set_ylabel(label)
    for one, label, part in ((axes[1], "axis left of it, mm", fit.plan), (axes[3], "axis above it, mm", fit.profile)):
        one.plot(part.station, 1e3 * part.residual, lw=0.8)
        one.set_ylabel(label)
        one.axhline(0.0, color="0.6", lw=0.6)
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(bore.position[:, :2], axis=0).T))])
    _mark_chainages(axes[3], run, chainage)
    axes[3].set_xlabel("chainage, m")
    _save(figure, path)


def draw_offsets(path: Path, chainage: Float[np.ndarray, " n"], right: Float[np.ndarray, " n"],
                 above: Float[np.ndarray, " n"] | None, name: str) -> None:  # fmt: skip
    """Draw the axis's offsets from a design axis along its chainage."""
    figure, one = plt.subplots(figsize=(11, 3), layout="constrained")
    one.plot(chainage, 1e3 * right, lw=0.9, label="to the right")
    if above is not None:
        one.plot(chainage, 1e3 * above, lw=0.9, label="above")
    one.set(xlabel="chainage of the design, m", ylabel="axis off the design, mm", title=name)
    one.legend()
    _save(figure, path)


def draw_clearance(path: Path, chainage: Float[np.ndarray, " n"], free: Float[np.ndarray, " n"], name: str) -> None:
    """Draw the least free distance along the track."""
    figure, one = plt.subplots(figsize=(11, 3), layout="constrained")
    one.plot(chainage, free, lw=0.9)
    one.axhline(0.0, color="#c62828", lw=0.8)
    one.set(xlabel="chainage, m", ylabel="free distance, m", title=f"around {name}")
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)
