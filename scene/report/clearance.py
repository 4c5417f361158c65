"""Free distance between a loading gauge on the track and everything around it.

The gauge moves out in bends: its middle by the centre throw, its ends by the end throw of the vehicle, and leans with
the cant.

Source: geometric overthrow of a vehicle with bogies `a` apart and ends `n` from the bogies on a bend of radius R:
centre a² / 8R, end n (a + n) / 2R, as in EN 15273-1; sway, tolerances and the standard's own allowances are left out.
"""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float

from scene.bore import Bore
from scene.errors import RecordingError, require_input

# Upper parts of the kinematic reference contours of 1435 mm track, right half from below, distance from the middle and
# height over rail, m, of Spain's railway gauging instruction (Instrucción ferroviaria de gálibos, Orden FOM/1630/2015),
# as two programs transcribe it with the same figures: github.com/Xema-Pastor/galibos_flet, datos_galibos.py at 057fb2a,
# and a calculator of gauges by another hand. The order itself was not at hand: check them before you rely on them.
_SIDE = ((1.620, 0.400), (1.620, 1.170), (1.645, 1.170))
CONTOURS = {
    "ga": (*_SIDE, (1.645, 3.250), (1.360, 3.880), (1.090, 4.080), (0.545, 4.350)),
    "gb": (*_SIDE, (1.645, 3.250), (1.360, 4.110), (0.545, 4.350)),
    "gc": (*_SIDE, (1.645, 3.550), (1.540, 4.700)),
}
_WIDEST = 60.0  # m; no section of a tunnel, and no gauge, is as large
BOGIES, OVERHANG = 19.0, 3.7  # m; a passenger coach of 26.4 m


@dataclass(frozen=True)
class Gauge:
    """A loading gauge.

    Attributes:
        name: Its name.
        points: Closed polygon, distance to the left of the track's middle and height over the rails, m.
    """

    name: str
    points: Float[np.ndarray, "k 2"]


def contour(name: str) -> Gauge:
    """Return the upper part of a reference contour of `CONTOURS`, without allowances."""
    right = np.array(CONTOURS[name])
    left = right[::-1] * [-1.0, 1.0]
    return Gauge(f"{name.upper()}, upper part", np.concatenate([right, left]))


def read_gauge(path: Path) -> Gauge:
    """Read a polygon: a CSV of rows `left, height` (m), the first row again at the end.

    Raises:
        RecordingError: A row holds no two numbers, or the polygon is not closed, crosses itself, has no area or is
            larger than any tunnel.
    """
    try:
        with require_input(path).open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row and not row[0].lstrip().startswith("#")]
        points = np.array([[float(cell) for cell in row] for row in rows])
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise ValueError("rows must be two numbers: left, height")
    except ValueError as error:
        raise RecordingError(f"{path}: not a polygon ({error})") from error
    if len(points) < 4 or np.any(np.abs(points[0] - points[-1]) > 1e-6):
        raise RecordingError(f"{path}: the polygon is not closed: its last row must be its first row again")
    if not shapely.Polygon(points).is_valid or shapely.Polygon(points).area <= 0.0:
        raise RecordingError(f"{path}: the polygon crosses itself")
    if np.ptp(points, axis=0).max() > _WIDEST:
        raise RecordingError(
            f"{path}: the polygon is {np.ptp(points, axis=0).max():.0f} m large; is it in millimetres?"
        )
    return Gauge(path.name, points[:-1])


@dataclass(frozen=True)
class Rails:
    """The middle of a track.

    Attributes:
        left: Its place to the left of the bore's axis at each station, m.
        up: Height of the top of the rails above the bore's axis, m.
        cant: Height of the left rail over the right one, m.
        gauge: Distance over which the cant is measured, m.
    """

    left: Float[np.ndarray, " n"]
    up: Float[np.ndarray, " n"]
    cant: Float[np.ndarray, " n"]
    gauge: float


_HEAD = re.compile(r'<geom name="rail_(left|right)_\d+_head" type="box" size="\S+ \S+ (\S+)" pos="([^"]+)"')


def read_rails(scene: Path, bore: Bore) -> Rails | None:
    """Read the first track's rails from a `scene.xml`; `None` where no track was laid.

    Raises:
        RecordingError: The file is missing, or a number in it is none.
    """
    sides: dict[str, list[list[float]]] = {"left": [], "right": []}
    for side, half, place in _HEAD.findall(require_input(scene).read_text()):
        x, y, z = (float(word) for word in place.split())
        sides[side].append([x, y, z + float(half)])
    if not (sides["left"] and sides["right"]):
        return None
    found = []
    for side in ("left", "right"):
        station, left, up = bore.axis.local(np.array(sides[side]))
        order = np.argsort(station)
        found.append([np.interp(bore.station, station[order], part[order]) for part in (left, up)])
    (left_y, left_z), (right_y, right_z) = found
    return Rails(
        0.5 * (left_y + right_y), 0.5 * (left_z + right_z), left_z - right_z, float(np.median(left_y - right_y))
    )


def bend(bore: Bore, rails: Rails, bogies: float = BOGIES) -> Float[np.ndarray, " n"]:
    """Return the curvature of the track that a vehicle's bogies see at each station, 1/m, to the left positive.

    It is 8 v / a² of the versine v over a chord of `bogies` (a) about the station: half a vehicle's length smooths the
    wander of a measured axis, of which the local curvature would make throws of decimetres. Within half a chord of the
    ends that of the last whole chord is taken; on a track shorter than a chord the whole of it is the chord.
    """
    track = (bore.position + rails.left[:, None] * bore.lateral)[:, :2]
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))])
    half = 0.5 * min(bogies, run[-1])
    middle = np.clip(run, half, run[-1] - half)
    before, at, after = (
        np.column_stack([np.interp(middle + shift, run, track[:, k]) for k in (0, 1)]) for shift in (-half, 0.0, half)
    )
    chord = after - before
    length = np.hypot(*chord.T)
    # Of a bend to the left the middle lies to the right of its chord.
    versine = (chord[:, 1] * (at - before)[:, 0] - chord[:, 0] * (at - before)[:, 1]) / length
    return 8.0 * versine / length**2


def throw(
    curvature: Float[np.ndarray, " n"], bogies: float = BOGIES, overhang: float = OVERHANG
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return how far a vehicle's middle moves to the inner side, and its ends to the outer side, m."""
    size = np.abs(curvature)
    return bogies**2 / 8.0 * size, overhang * (bogies + overhang) / 2.0 * size


def clearance(bore: Bore, rails: Rails, gauge: Gauge, curvature: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the least free distance at each station, and where on the wall it is: left of and above the axis, m.

    Below 0 where the gauge cuts the wall: minus the depth of the deepest wall point inside it.
    """
    inner, outer = throw(curvature)
    result = np.empty((len(bore.station), 3))
    y, z = bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    for k in range(len(bore.station)):
        side = np.sign(curvature[k])  # the inner side of a bend to the left is the left
        shifts = sorted((side * inner[k], -side * outer[k]))
        body = shapely.unary_union([_placed(gauge, rails, k, shift) for shift in shifts]).convex_hull
        wall = shapely.LinearRing(np.column_stack([y[k], z[k]]))
        points = shapely.points(y[k], z[k])
        inside = shapely.contains_xy(body, y[k], z[k])
        if inside.any():
            depth = shapely.distance(points, body.exterior) * inside
            worst = int(np.argmax(depth))
            result[k] = -depth[worst], y[k, worst], z[k, worst]
        else:
            near = shapely.shortest_line(body, wall)
            result[k] = near.length, *near.coords[-1]
    return result


def _placed(gauge: Gauge, rails: Rails, k: int, shift: float) -> shapely.Polygon:
    """Return the gauge on the rails of a station, moved aside and leaning with the cant."""
    lean = np.arcsin(np.clip(rails.cant[k] / rails.gauge, -1.0, 1.0))
    across, above = gauge.points[:, 0] + shift, gauge.points[:, 1]
    # With the left rail higher the body leans to the right.
    y = rails.left[k] + across * np.cos(lean) - above * np.sin(lean)
    z = rails.up[k] + above * np.cos(lean) + across * np.sin(lean)
    return shapely.Polygon(np.column_stack([y, z]))
