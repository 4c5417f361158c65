"""Smooth cross-sections of lining and reference in the same planes, as polygons about the reference axis."""

from dataclasses import dataclass

import numpy as np
import shapely
import trimesh
from jaxtyping import Bool, Float
from scipy.signal import detrend

from benchmarks.fidelity.case import Case, derived, of_hold, of_truth, until
from benchmarks.fidelity.derive import profiles
from benchmarks.fidelity.derive.curve import Curve, truth_curve
from benchmarks.fidelity.derive.reference_axis import hold_curve, hold_local, lining_caster, reference_curve
from benchmarks.fidelity.derive.surface import Caster

SHELL = ("lining", "joint", "pocket", "floor")  # parts of the truth that bound the air
EVERY = 1.0  # m
END = 0.75  # m from the mouths where no window is whole
WIDTH_HEIGHT = 1.2  # m above the floor
_CLOSED = 0.7  # share of the directions that must meet the lining


@dataclass(frozen=True)
class Sections:
    """Sections every metre of the reference axis.

    Attributes:
        station: m, `(n,)`.
        angle: From left towards up, rad, `(m,)`.
        judged: Polar radius of the lining, m; 0 in a section that is not closed, `(n, m)`.
        reference: The same of the reference; NaN where it is not known, `(n, m)`.
        judged_outline, reference_outline: Polygons in (left, up), `(n,)`.
    """

    station: Float[np.ndarray, " n"]
    angle: Float[np.ndarray, " m"]
    judged: Float[np.ndarray, "n m"]
    reference: Float[np.ndarray, "n m"]
    judged_outline: np.ndarray
    reference_outline: np.ndarray

    @property
    def common(self) -> np.ndarray:
        """What both outlines hold, `(n,)` polygons."""
        return shapely.intersection(self.judged_outline, self.reference_outline)


def true_part(case: Case, names: tuple[str, ...]) -> trimesh.Trimesh:
    """Those parts of the true surface."""
    truth = case.truth
    assert truth is not None
    kept = np.isin(truth.part, [truth.parts.index(name) for name in names if name in truth.parts])
    return trimesh.Trimesh(truth.surface.vertices, truth.surface.faces[kept], process=False)


@until("F2D")
@of_truth
def truth_shell(case: Case) -> Caster:
    """Rays in the true bore: lining with its joints and pockets, floor; no track."""
    return Caster(true_part(case, SHELL))


def rows(curve: Curve) -> Float[np.ndarray, " n"]:
    """Stations of the rows that medians are taken over."""
    return np.arange(curve.station[0] + 0.5 * profiles.STEP, curve.station[-1], profiles.STEP)


@of_truth
def truth_rows(case: Case) -> Float[np.ndarray, "n m"]:
    """Smooth polar radii of the truth in 360 directions, m."""
    curve = truth_curve(case)
    cast = profiles.cast(truth_shell(case), curve, rows(curve), profiles.directions(360))
    return profiles.windowed(cast, profiles.STEP)


@of_hold
def hold_rows(case: Case) -> Float[np.ndarray, "n m"]:
    """Smooth polar radii of the held-out recording by 5 degree sector, m; NaN where too few points lie."""
    curve = hold_curve(case)
    local = hold_local(case)
    low = (np.abs(local[:, 1]) > profiles.TRACK_HALF) & (local[:, 2] < -1.0) & (np.abs(local[:, 1]) < 2.0)
    floor = float(np.median(local[low, 2])) if low.any() else None
    station = np.arange(curve.station[0], curve.station[-1], profiles.SLICE)
    return profiles.windowed(profiles.of_points(local, station, floor), profiles.SLICE)


@derived
def sections(case: Case) -> Sections:
    """Sections of both, the reference being the truth where there is one.

    Pockets and joints fall to the median over 1.5 m. Against a held-out recording the lining is measured in the same
    5 degree sectors as the points, and only sectors that they show count.

    Raises:
        ValueError: The reference is shorter than two sections.
    """
    curve, angle = reference_curve(case), profiles.directions(360)
    raw = profiles.cast(lining_caster(case), curve, rows(curve), angle)
    cast = profiles.windowed(raw, profiles.STEP)
    if case.truth is not None:
        reference, place = truth_rows(case), rows(curve)
    else:
        reference = hold_rows(case)
        place = curve.station[0] + profiles.SLICE * np.arange(len(reference))
        angle = profiles.directions(reference.shape[1])
        cast = profiles.nanmedian(cast.reshape(len(cast), len(angle), -1))
    station = np.arange(curve.station[0] + END, curve.station[-1] - END + 1e-9, EVERY)
    if len(station) < 2:
        raise ValueError("the reference is too short for sections")
    reference = reference[np.argmin(np.abs(place - station[:, None]), axis=1)]
    row = np.argmin(np.abs(rows(curve) - station[:, None]), axis=1)
    judged, closed = cast[row], np.isfinite(raw[row]).mean(axis=1) > _CLOSED  # a median reaches past a mouth
    whole = np.isfinite(reference).mean(axis=1) > _CLOSED
    station, reference, judged, closed = station[whole], reference[whole], judged[whole], closed[whole]
    judged = np.where(closed[:, None], judged, 0.0)
    known = np.isfinite(reference)
    return Sections(
        station, angle, judged, reference,
        outlines(judged, angle, known), outlines(reference, angle, known),
    )  # fmt: skip


def outlines(
    radius: Float[np.ndarray, "n m"], angle: Float[np.ndarray, " m"], known: Bool[np.ndarray, "n m"]
) -> np.ndarray:
    """Polygons through the known radii, straight across what is not known; empty where nothing is, `(n,)`."""
    points = radius[..., None] * np.column_stack([np.cos(angle), np.sin(angle)])
    kept = known & np.isfinite(radius) & (radius > 0)
    rings = [
        shapely.Polygon(row[keep]) if keep.sum() > 3 else shapely.Polygon()
        for row, keep in zip(points, kept, strict=True)
    ]
    return shapely.make_valid(np.array(rings, object))


def widths(outline: np.ndarray, above: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Width of each outline at heights above the axis, m; 0 of one that is empty."""
    lines = shapely.linestrings([[(-50.0, z), (50.0, z)] for z in above])
    return shapely.length(shapely.intersection(outline, lines))


def heights(outline: np.ndarray) -> Float[np.ndarray, " n"]:
    """Height of each outline on the axis, m."""
    return shapely.length(shapely.intersection(outline, shapely.LineString([(0.0, -50.0), (0.0, 50.0)])))


@derived
def dimensions(case: Case) -> dict[str, Float[np.ndarray, "2 n"]]:
    """`width` at 1.2 m above the reference's floor, `height` and `area` of lining and reference."""
    cut = sections(case)
    down = shapely.bounds(cut.reference_outline)[:, 1]
    both = (cut.judged_outline, cut.reference_outline)
    return {
        "width": np.array([widths(outline, down + WIDTH_HEIGHT) for outline in both]),
        "height": np.array([heights(outline) for outline in both]),
        "area": np.array([shapely.area(outline) for outline in both]),
    }


@derived
def variation(case: Case) -> Float[np.ndarray, "2 n 2"]:
    """Width and height of lining and reference less their straight trends along the tunnel, m."""
    size = dimensions(case)
    stacked = np.stack([size["width"], size["height"]], axis=-1)
    return detrend(stacked, axis=1)
