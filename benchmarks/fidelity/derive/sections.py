"""Cross-sections: smooth outlines every metre, and polar radii with pockets every 5 cm."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.signal import detrend

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold, per_truth
from benchmarks.fidelity.derive import curve as curves
from benchmarks.fidelity.derive.axis import hold_curve, hold_local, lining_caster, lining_curve, reference_curve
from benchmarks.fidelity.derive.surface import Caster

SHELL_PARTS = ("lining", "joint", "pocket", "floor")  # parts of the truth that bound the air
SECTION_STEP = 1.0  # m
SECTION_END = 0.75  # m from the mouths where no window is whole
WIDTH_HEIGHT = 1.2  # m above the floor
_CLOSED_SHARE = 0.7  # fraction of the directions that must meet the lining


@dataclass(frozen=True)
class Sections:
    """Sections every metre of the reference axis."""

    station: Float[np.ndarray, " n"]  # Stations, m
    angle: Float[np.ndarray, " m"]  # Angles from left towards up, rad
    judged: Float[np.ndarray, "n m"]  # Polar radius of the lining, m; 0 in a section that is not closed
    reference: Float[np.ndarray, "n m"]  # Polar radius of the reference, m; NaN where it is not known
    judged_outline: np.ndarray  # judged_outline, reference_outline: Polygons in (left, up)
    reference_outline: np.ndarray

    @property
    def common(self) -> np.ndarray:
        """Intersection of both outlines, `(n,)` polygons."""
        return shapely.intersection(self.judged_outline, self.reference_outline)


@kept_until("SEC", per_truth)
def truth_bore_caster(case: Case) -> Caster:
    """Return the caster of rays into the true bore: lining with joints and pockets, floor; no track."""
    assert case.truth is not None
    return Caster(case.truth.faces(*SHELL_PARTS))


def row_stations(curve: curves.Curve) -> Float[np.ndarray, " n"]:
    return np.arange(curve.station[0] + 0.5 * curves.ROW_STEP, curve.station[-1], curves.ROW_STEP)


@per_truth
def truth_radius_rows(case: Case) -> Float[np.ndarray, "n m"]:
    """Return smooth polar radii of the truth in 360 directions, m."""
    curve = curves.truth_curve(case)
    cast = curves.cast_profile(truth_bore_caster(case), curve, row_stations(curve), curves.section_angles(360))
    return curves.running_median(cast, curves.ROW_STEP)


@per_hold
def hold_radius_rows(case: Case) -> Float[np.ndarray, "n m"]:
    """Return smooth polar radii of the recording by 5 degree sector, m; NaN where too few points lie."""
    curve = hold_curve(case)
    local = hold_local(case)
    low = (np.abs(local[:, 1]) > curves.TRACK_HALF) & (local[:, 2] < -1.0) & (np.abs(local[:, 1]) < 2.0)
    floor = float(np.median(local[low, 2])) if low.any() else None
    station = np.arange(curve.station[0], curve.station[-1], curves.SLICE)
    return curves.running_median(curves.point_profile(local, station, floor), curves.SLICE)


@per_case
def sections(case: Case) -> Sections:
    """Return the sections of lining and reference; the truth is the reference where there is one.

    Pockets and joints fall to the median over 1.5 m. Against a held-out recording the lining is measured in the same
    5 degree sectors as the points, and only sectors that they show count.
    """
    curve, angle = reference_curve(case), curves.section_angles(360)
    raw = curves.cast_profile(lining_caster(case), curve, row_stations(curve), angle)
    cast = curves.running_median(raw, curves.ROW_STEP)
    if case.truth is not None:
        reference, place = truth_radius_rows(case), row_stations(curve)
    else:
        reference = hold_radius_rows(case)
        place = curve.station[0] + curves.SLICE * np.arange(len(reference))
        angle = curves.section_angles(reference.shape[1])
        cast = curves.nanmedian(cast.reshape(len(cast), len(angle), -1))
    station = np.arange(curve.station[0] + SECTION_END, curve.station[-1] - SECTION_END + 1e-9, SECTION_STEP)
    if len(station) < 2:
        raise ValueError("the reference is too short for sections")
    reference = reference[np.argmin(np.abs(place - station[:, None]), axis=1)]
    row = np.argmin(np.abs(row_stations(curve) - station[:, None]), axis=1)
    judged, closed = cast[row], np.isfinite(raw[row]).mean(axis=1) > _CLOSED_SHARE  # a median reaches past a mouth
    whole = np.isfinite(reference).mean(axis=1) > _CLOSED_SHARE
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
    """Return polygons through the known radii, straight across gaps; empty where nothing is known, `(n,)`."""
    points = radius[..., None] * np.column_stack([np.cos(angle), np.sin(angle)])
    kept = known & np.isfinite(radius) & (radius > 0)
    rings = [
        shapely.Polygon(row[keep]) if keep.sum() > 3 else shapely.Polygon()
        for row, keep in zip(points, kept, strict=True)
    ]
    return shapely.make_valid(np.array(rings, object))


def widths(outline: np.ndarray, above: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the width of each outline at heights above the axis, m; 0 of one that is empty."""
    lines = shapely.linestrings([[(-50.0, z), (50.0, z)] for z in above])
    return shapely.length(shapely.intersection(outline, lines))


def heights(outline: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the height of each outline on the axis, m."""
    return shapely.length(shapely.intersection(outline, shapely.LineString([(0.0, -50.0), (0.0, 50.0)])))


@per_case
def dimensions(case: Case) -> dict[str, Float[np.ndarray, "2 n"]]:
    """Return `width` at 1.2 m above the reference's floor, `height` and `area` of lining and reference."""
    cut = sections(case)
    down = shapely.bounds(cut.reference_outline)[:, 1]
    both = (cut.judged_outline, cut.reference_outline)
    return {
        "width": np.array([widths(outline, down + WIDTH_HEIGHT) for outline in both]),
        "height": np.array([heights(outline) for outline in both]),
        "area": np.array([shapely.area(outline) for outline in both]),
    }


@per_case
def variation(case: Case) -> Float[np.ndarray, "2 n 2"]:
    """Return width and height of lining and reference less their straight trends along the tunnel, m."""
    size = dimensions(case)
    stacked = np.stack([size["width"], size["height"]], axis=-1)
    return detrend(stacked, axis=1)


# Polar radii with pockets: every 5 cm along the axis, every degree around it.

ROW = 0.05  # m
COLUMNS = 360


@dataclass(frozen=True)
class Radii:
    """Bore seen from its axis."""

    curve: curves.Curve  # Axis of the bore
    station: Float[np.ndarray, " n"]  # Stations of the rows, m
    radius: Float[np.ndarray, "n m"]  # Distance to the first surface, m; NaN where there is none
    filled: Float[np.ndarray, "n m"]  # Radius with holes closed by their nearest neighbour, m

    def depth(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """Return the depth of points inside the bore, along the ray from the axis, m; negative outside."""
        return curves.by_parts(lambda part: self.depth_local(self.curve.local(part)), points)

    def depth_local(self, local: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """Return that depth of points given as station, left and up about `curve`, m."""
        row = np.clip(np.round((local[:, 0] - self.station[0]) / ROW).astype(int), 0, len(self.station) - 1)
        angle = (np.arctan2(local[:, 2], local[:, 1]) + np.pi) / (2 * np.pi) * COLUMNS
        column = np.minimum(angle.astype(int), COLUMNS - 1)
        inside = self.filled[row, column] - np.hypot(local[:, 1], local[:, 2])
        low, high = self.station[0] - ROW, self.station[-1] + ROW
        beyond = np.maximum(low - local[:, 0], local[:, 0] - high)
        return np.where(beyond > 0, -np.maximum(beyond, 1e-9), inside)


def cast_radii(curve: curves.Curve, caster: Caster) -> Radii:
    count = max(int(curve.length / ROW), 2)
    station = curve.station[0] + (np.arange(count) + 0.5) * curve.length / count
    radius = curves.cast_profile(caster, curve, station, curves.section_angles(COLUMNS))
    if np.isfinite(radius).mean() < 0.5:
        raise ValueError("most rays from the axis leave the bore")
    return Radii(curve, station, radius, _close_holes(radius))


def _close_holes(radius: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    known = np.isfinite(radius)
    if known.all():
        return radius
    margin = COLUMNS // 8
    around = np.concatenate([radius[:, -margin:], radius, radius[:, :margin]], axis=1)
    nearest = distance_transform_edt(~np.isfinite(around), return_distances=False, return_indices=True)
    return around[tuple(nearest)][:, margin:-margin]


@per_case
def lining_radii(case: Case) -> Radii:
    return cast_radii(lining_curve(case), lining_caster(case))


@per_truth
def truth_radii(case: Case) -> Radii:
    return cast_radii(curves.truth_curve(case), truth_bore_caster(case))


@kept_until("NAV", per_truth)
def truth_caster(case: Case) -> Caster:
    assert case.truth is not None
    return Caster(case.truth.surface)
