"""The bore as a table: a row a metre of chainage or a ring, with sizes, best-fit circle, deviation from a design."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from scene.bore import Bore
from scene.errors import FitError

ROW = np.dtype([
    (name, "f8")
    for name in (
        "station", "chainage", "easting", "northing", "elevation", "width", "height", "area", "circle_radius",
        "circle_left", "circle_up", "circle_rms", "largest_diameter", "smallest_diameter", "ovality", "over", "under",
        "deviation_mean", "deviation_most", "deviation_least", "residual", "coverage", "confidence",
    )
] + [("filled", "?")])  # fmt: skip


@dataclass(frozen=True)
class DesignSection:
    """The section that was to be built.

    Attributes:
        name: Where it comes from, for people.
        radius: Distance from the bore's axis at each of its angles, m, for each station.
    """

    name: str
    radius: Float[np.ndarray, "n m"]


def own_section(bore: Bore) -> DesignSection:
    """Return the median section of each stretch as its design, for want of another one."""
    radius = np.broadcast_to(np.median(bore.radius, axis=0), bore.radius.shape).copy()
    for stretch in bore.stretch:
        rows = (bore.station >= stretch["start"]) & (bore.station <= stretch["end"])
        if rows.any():
            radius[rows] = np.median(bore.radius[rows], axis=0)
    return DesignSection("the bore's own median section, for want of a design", radius)


def circle_section(bore: Bore, radius: float) -> DesignSection:
    """Return a circle about the middle of each section's best-fit circle.

    Raises:
        FitError: The radius does not lie between 0.5 and 30 m, or the circle does not hold the bore's axis.
    """
    if not 0.5 <= radius <= 30.0:
        raise FitError(f"a design radius must lie between 0.5 and 30 m, got {radius:g}")
    left, up, _, _ = fit_circles(bore)
    cosine, sine = np.cos(bore.angle), np.sin(bore.angle)
    along = left[:, None] * cosine + up[:, None] * sine
    inside = along**2 + radius**2 - (left**2 + up**2)[:, None]
    if np.any(inside <= 0.0):
        raise FitError(f"a circle of {radius:g} m does not hold the axis of the bore; is its section a circle?")
    return DesignSection(f"a circle of {radius:g} m about the best-fit middle", along + np.sqrt(inside))


def polygon_section(bore: Bore, points: Float[np.ndarray, "k 2"], name: str) -> DesignSection:
    """Return a closed polygon of points left of and above the axis (m) as the design everywhere.

    Raises:
        FitError: A ray from the axis meets the polygon not just once.
    """
    return DesignSection(name, np.broadcast_to(polar(points, bore.angle, name), bore.radius.shape))


def polar(points: Float[np.ndarray, "k 2"], angle: Float[np.ndarray, " m"], name: str) -> Float[np.ndarray, " m"]:
    """Return the distance from the origin to a closed polygon in each direction, m.

    Raises:
        FitError: The origin is not inside, or a ray meets the polygon more than once.
    """
    start, end = points, np.roll(points, -1, axis=0)
    edge = end - start
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cross = heading[:, None, 0] * edge[None, :, 1] - heading[:, None, 1] * edge[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0])[None] / cross
        share = (start[None, :, 0] * heading[:, None, 1] - start[None, :, 1] * heading[:, None, 0]) / cross
    met = (distance > 0.0) & (share >= 0.0) & (share < 1.0)
    if np.any(met.sum(axis=1) != 1):
        raise FitError(f"{name}: a ray from the axis meets this section not just once, so it is none about the axis")
    return distance[met]


def fit_circles(bore: Bore) -> tuple[Float[np.ndarray, " n"], ...]:
    """Return middle (left of and above the axis), radius and RMS residual of each section's best-fit circle, m.

    The circle is the geometric one: the least sum of squared distances of the wall's points.
    """
    y, z = bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    left, up, radius = y.mean(axis=1), z.mean(axis=1), bore.radius.mean(axis=1)
    for _ in range(20):
        across, above = y - left[:, None], z - up[:, None]
        distance = np.hypot(across, above)
        miss = distance - radius[:, None]
        matrix = np.stack([-across / distance, -above / distance, -np.ones_like(distance)], axis=-1)
        normal, right = np.einsum("nmi,nmj->nij", matrix, matrix), -np.einsum("nmi,nm->ni", matrix, miss)
        step = np.linalg.solve(normal, right[..., None])
        left, up, radius = left + step[:, 0, 0], up + step[:, 1, 0], radius + step[:, 2, 0]
    miss = np.hypot(y - left[:, None], z - up[:, None]) - radius[:, None]
    return left, up, radius, np.sqrt(np.mean(miss**2, axis=1))


def at_round_chainages(bore: Bore, chainage: Float[np.ndarray, " n"], every: float) -> Float[np.ndarray, " k"]:
    """Return the stations at which the chainage is a multiple of `every`, in the order of the bore, m.

    Args:
        bore: The bore.
        chainage: Chainage of each station, growing or falling along the bore, m.
        every: Distance from row to row in chainage, m.
    """
    way = 1.0 if chainage[-1] > chainage[0] else -1.0
    first, last = np.sort(chainage[[0, -1]])
    rounding = 1e-3 / every  # an end a millimetre short of a round chainage is at it
    wanted = np.arange(np.ceil(first / every - rounding), np.floor(last / every + rounding) + 1.0) * every
    return np.interp(way * wanted[:: int(way)], way * chainage, bore.station)


def nearest_rows(bore: Bore, station: Float[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """Return the rows of the bore nearest to stations."""
    return np.rint(np.interp(station, bore.station, np.arange(len(bore.station)))).astype(int)


def tabulate(
    bore: Bore,
    design: DesignSection,
    origin: Float[np.ndarray, "3"],
    chainage: Float[np.ndarray, " n"],
    wanted: Float[np.ndarray, " k"],
) -> np.ndarray:
    """Return the table, `(k,)` of `ROW`; m, m².

    Places are those of the stations asked for; sizes are those of the bore's section nearest to each.

    Args:
        bore: The bore.
        design: The section that was to be built.
        origin: Offset of the tunnel frame, m.
        chainage: Chainage of each station of the bore, m.
        wanted: Stations of the rows, m.
    """
    rows = nearest_rows(bore, wanted)
    left, up, radius, rms = (values[rows] for values in fit_circles(bore))
    off = bore.radius[rows] - design.radius[rows]
    step = 2.0 * np.pi / len(bore.angle)
    slice_area = 0.5 * (bore.radius[rows] ** 2 - design.radius[rows] ** 2) * step
    most, least = diameters(bore.radius[rows], bore.angle)
    table = np.zeros(len(rows), ROW)
    place = bore.axis.at(wanted).position + origin
    values = {
        "station": wanted, "chainage": np.interp(wanted, bore.station, chainage), "easting": place[:, 0],
        "northing": place[:, 1], "elevation": place[:, 2], "width": bore.width[rows], "height": bore.height[rows],
        "area": 0.5 * step * np.sum(bore.radius[rows] ** 2, axis=1), "circle_radius": radius, "circle_left": left,
        "circle_up": up, "circle_rms": rms, "largest_diameter": most, "smallest_diameter": least,
        "ovality": (most - least) / (0.5 * (most + least)), "over": np.maximum(slice_area, 0.0).sum(axis=1),
        "under": -np.minimum(slice_area, 0.0).sum(axis=1), "deviation_mean": off.mean(axis=1),
        "deviation_most": off.max(axis=1), "deviation_least": off.min(axis=1), "residual": bore.residual_rms[rows],
        "coverage": bore.coverage[rows], "confidence": bore.confidence[rows], "filled": bore.filled[rows],
    }  # fmt: skip
    for name, column in values.items():
        table[name] = column
    return table


def diameters(
    radius: Float[np.ndarray, "n m"], angle: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the largest and smallest distance of two parallel tangents around each section, m."""
    y, z = radius * np.cos(angle), radius * np.sin(angle)
    turns = np.linspace(0.0, np.pi, 180, endpoint=False)
    extent = [np.ptp(y * np.cos(turn) + z * np.sin(turn), axis=1) for turn in turns]
    return np.max(extent, axis=0), np.min(extent, axis=0)


def volumes(bore: Bore, design: DesignSection) -> tuple[float, float]:
    """Return over- and underbreak of the whole bore by the trapezoidal rule, m³."""
    slices = (bore.radius**2 - design.radius**2) * np.pi / len(bore.angle)
    over, under = (np.maximum(way * slices, 0.0).sum(axis=1) for way in (1.0, -1.0))
    return float(np.trapezoid(over, bore.station)), float(np.trapezoid(under, bore.station))
