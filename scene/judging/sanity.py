"""Checks for what no tunnel has, with likely causes (unit, axes, poses, clock), and for tracks beyond what was seen.

A wall may stand twice in a cloud: passes that do not fit each other, or poses that drifted.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, cKDTree

from scene.bore import Bore
from scene.cloud import Cloud
from scene.errors import Code
from scene.fitting.trackseen import SeenTrack
from scene.geometry import find_runs
from scene.judging.judge import Warned
from scene.judging.places import name_span
from scene.writing.track import Track

_PLACES = 1500  # of the wall that are looked at
_REACH = 0.22  # m around a place
_LEAST_POINTS = 24  # points of a place
_NEAR_WALL = 0.30  # m
_LOWEST = -0.3  # sine of the lowest direction: sleepers and ballast below it are two layers, too
_THINNEST = 0.02  # m between two layers; nearer is noise
_APART = 0.92  # fraction of the variance that lies between two halves: 0.64 of one noisy layer, 0.75 of an even one
_HALF = 0.15  # least fraction of the points in each layer
_MIXED = 0.5  # of the neighbours in other layers that points at random would have
_DOUBLED = 0.25  # fraction of the places
_WINDOW = 10.0  # m


def doubt_layers(bore: Bore, cloud: Cloud) -> list[Warned]:
    """Warn of a wall that most places of some stretch show twice, a few centimetres apart."""
    station, lateral, upward = bore.axis.local(cloud.points.astype(np.float64))
    angle = np.arctan2(upward, lateral)
    column = np.rint((angle - bore.angle[0]) / (2 * np.pi) * len(bore.angle)).astype(np.intp) % len(bore.angle)
    on_wall = np.abs(np.hypot(lateral, upward) - bore.radius[bore.row_of(station), column]) < _NEAR_WALL
    on_wall &= (np.sin(angle) > _LOWEST) & (station > 0) & (station < bore.length)
    wall = cloud.points[on_wall].astype(np.float64)
    if len(wall) < _PLACES:
        return []
    picked = np.arange(0, len(wall), max(1, len(wall) // _PLACES))
    near = cKDTree(wall).query_ball_point(wall[picked], _REACH)
    apart = np.array([layers_apart(wall[rows]) if len(rows) >= _LEAST_POINTS else np.nan for rows in near])
    at, known = station[on_wall][picked], np.isfinite(apart)
    if known.sum() < _PLACES / 10:
        return []
    doubled = known & (apart > 0)
    count = max(round(bore.length / _WINDOW), 1)
    window = np.minimum((at / bore.length * count).astype(np.intp), count - 1)
    twice = np.bincount(window[doubled], minlength=count) / np.maximum(np.bincount(window[known], minlength=count), 1)
    rows = np.flatnonzero(twice > _DOUBLED)
    if not len(rows):
        return []
    widest = 100 * float(np.percentile(apart[doubled], 90))
    start, end = rows[0] / count * bore.length, (rows[-1] + 1) / count * bore.length
    return [Warned(
        Code.DOUBLED,
        f"{name_span(start, end)} the wall shows twice, up to {widest:.0f} cm apart, at "
        f"{doubled[known].mean():.0%} of its places: two passes of the scan do not fit each other, its poses "
        "drifted, or the odometry stood still; register them first: the wall that was built is neither",
        float(start), float(end),
    )]  # fmt: skip


def layers_apart(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the distance of two parallel layers that a patch of points makes up, m; 0 where it is one.

    Two passes lie over each other; panels and ribs lie side by side, and make no layers.
    """
    centred = points - points.mean(axis=0)
    frame = np.linalg.eigh(centred.T @ centred)[1]
    off, place = centred @ frame[:, 0], centred @ frame[:, 1:]
    order = np.argsort(off)
    n, below = len(off), np.arange(1, len(off))
    total = np.cumsum(off[order])[:-1]
    between = total**2 / below + total**2 / (n - below)  # the mean of all is 0
    inner = (below > _HALF * n) & (below < (1 - _HALF) * n)
    cut = int(np.argmax(np.where(inner, between, 0.0)))
    upper = np.zeros(n, bool)
    upper[order[cut + 1 :]] = True
    apart = float(off[upper].mean() - off[~upper].mean())
    if apart < _THINNEST or between[cut] < _APART * float(off @ off):
        return 0.0
    nearest = cKDTree(place).query(place, 2)[1][:, 1]
    by_chance = 2 * upper.mean() * (1 - upper.mean())
    return apart if np.mean(upper != upper[nearest]) > _MIXED * by_chance else 0.0


_SIZES = (1.0, 30.0)  # m, widths and heights of bores that people make
_HIGH = 11.0  # m; higher are caverns and stations, and common tunnels in feet
_USUAL = (2.0, 12.0)  # m, sizes by which another unit is proposed
_UNITS = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048, "m": 1.0}
_STEEP, _LYING = 0.20, 0.80  # grade: no road or railway climbs more than a fifth; at 40° it is no tunnel to drive in
_FLAT, _ROUND = 0.02, 0.10  # m: departure of a side from a straight line that is a floor's, and a crown's
_DENT, _DENT_LENGTH = 0.25, 3.0  # m inwards, and along the bore: deeper and longer than roughness and noise
_OVERHEAD = 0.7  # sine of the lowest direction of a dent: walls under an open ceiling, and platforms, step in rightly
_FACING = np.deg2rad(35)  # to each side of a direction


def doubt_bore(bore: Bore, facts: dict[str, Any], provenance: dict[str, str], surveyed: bool) -> list[Warned]:
    """Return what is odd about a bore as a tunnel, and what nobody measured.

    `facts` and `provenance` are entries of the manifest. Nobody expects a survey of rings, not `surveyed` by a scanner,
    to show pockets.
    """
    return [
        *_doubt_size(bore, str(facts.get("unit", "m"))), *_doubt_grade(bore, str(facts.get("axes", "xyz"))),
        *_doubt_lying(bore), *doubt_shaft(bore, str(facts.get("axes", ""))), *_doubt_dents(bore),
        *_doubt_poses(facts), *_doubt_rounding(facts), *(_tell_standard(bore, provenance) if surveyed else []),
    ]  # fmt: skip


def _doubt_size(bore: Bore, unit: str) -> list[Warned]:
    width, height = float(np.median(bore.width)), float(np.median(bore.height))
    size = f"the bore would be {width:.3g} m wide and {height:.3g} m high"
    by_flag = "by flag" in unit
    if not all(_SIZES[0] <= value <= _SIZES[1] for value in (width, height)):
        return [Warned(Code.SIZE, f"{size}, and no tunnel is; {_propose_unit(width, height, unit)}", refuses=True)]
    if height > _HIGH and not by_flag:
        return [Warned(Code.SIZE, f"{size}: a cavern, or is the unit another? {_propose_unit(width, height, unit)}")]
    return []


def _propose_unit(width: float, height: float, unit: str) -> str:
    """Return the units that would make the sizes usual, in words; `unit` begins with the one that was taken."""
    taken = _UNITS.get(unit.split(" ")[0], 1.0)
    options = []
    for name, metres in _UNITS.items():
        sizes = [value / taken * metres for value in (width, height)]
        if metres != taken and all(_USUAL[0] <= size <= _USUAL[1] for size in sizes):
            options.append(f"--unit {name} makes it {sizes[0]:.2g} m by {sizes[1]:.2g} m")
    return " or ".join(options) or f"was its unit read rightly ({unit})?"


def _doubt_grade(bore: Bore, axes: str) -> list[Warned]:
    grade = bore.axis.grade
    steep = np.abs(grade) > _STEEP
    if not steep.any():
        return []
    usual, worst = float(np.median(np.abs(grade))), float(np.abs(grade).max())
    rows = np.flatnonzero(steep)
    start, end = float(bore.station[rows[0]]), float(bore.station[rows[-1]])
    lying = usual > _LYING
    climbs = f"{name_span(start, end)} the bore climbs at up to {worst:.0%}"
    cause = (
        f"z is not up in this file (axes {axes.split(' ')[0]}); {_propose_axes(bore)}"
        if lying
        else "is z up (--axes), and were the poses levelled (roll and pitch of the mount)?"
    )
    text = f"{climbs}, where no road or railway climbs at more than 20 %: {cause}"
    return [Warned(Code.GRADE, text, start, end, lying)]


def _propose_axes(bore: Bore) -> str:
    run = bore.position[-1] - bore.position[0]
    names = {0: "--axes yzx", 1: "--axes x-zy"}
    for axis in (1, 0):
        if abs(run[axis]) < _STEEP * float(np.linalg.norm(np.delete(run, axis))):
            return f"{names[axis]} takes {'xy'[axis]} as up"
    return "--axes says which axis is"


def _doubt_lying(bore: Bore) -> list[Warned]:
    """Warn of a section whose flat side is a wall and whose round side is the other: a tunnel that lies on its side."""
    section = np.median(bore.radius, axis=0)
    for name, angle in (("left", 0.0), ("right", np.pi)):
        if _bend(bore.angle, section, angle) < _FLAT and _bend(bore.angle, section, angle + np.pi) > _ROUND:
            floor, crown = (_bend(bore.angle, section, side * np.pi / 2) for side in (-1, 1))
            if min(floor, crown) > _FLAT or abs(floor - crown) < _FLAT:
                return [Warned(
                    Code.LYING,
                    f"the section is flat on the {name} and round on the other side, as a tunnel on its side is: is z "
                    "up? --axes x-zy or --axes yzx takes another axis as up",
                )]  # fmt: skip
    return []


def _doubt_dents(bore: Bore) -> list[Warned]:
    """Warn of a crown that is dented inwards over some metres: what hangs under it was taken for the lining.

    The depth is that of the section below its convex hull, along the radius.
    """
    y, z = bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    depth = np.zeros_like(bore.radius)
    for row in range(len(bore.station)):
        corners = ConvexHull(np.column_stack([y[row], z[row]])).vertices
        corners = corners[np.argsort(bore.angle[corners])]
        depth[row] = _hull_radius(bore.angle, bore.angle[corners], bore.radius[row, corners]) - bore.radius[row]
    depth[:, np.sin(bore.angle) < _OVERHEAD] = 0.0
    result = []
    for first, last in find_runs(depth.max(axis=1) > _DENT) - np.array([0, 1]):
        start, end = float(bore.station[first]), float(bore.station[last])
        if end - start < _DENT_LENGTH:
            continue
        here = depth[first : last + 1]
        result.append(Warned(
            Code.DENT,
            f"{name_span(start, end)} the section is dented inwards by up to {here.max():.1f} m at the crown: a duct, "
            "pipes or lamps may have been taken for the lining",
            start, end,
        ))  # fmt: skip
    return result


def _hull_radius(
    angle: Float[np.ndarray, " m"], at: Float[np.ndarray, " c"], radius: Float[np.ndarray, " c"]
) -> Float[np.ndarray, " m"]:
    """Distance along each direction to the sides of a convex polygon with corners in the order of their angle, m."""
    right = np.searchsorted(at, angle, side="right")
    low, high = (right - 1) % len(at), right % len(at)
    y0, z0, y1, z1 = (f(at[k]) * radius[k] for k in (low, high) for f in (np.cos, np.sin))
    across, along = y1 - y0, z1 - z0
    turn = np.cos(angle) * along - np.sin(angle) * across
    return np.where(np.abs(turn) > 1e-9, (y0 * along - z0 * across) / np.where(turn == 0, 1.0, turn), radius[low])


def _bend(angle: Float[np.ndarray, " m"], radius: Float[np.ndarray, " m"], facing: float) -> float:
    """RMS departure of the side that faces a direction from a straight line, m."""
    turn = np.angle(np.exp(1j * (angle - facing)))
    near = np.abs(turn) < _FACING
    across, along = (radius * np.sin(turn))[near], (radius * np.cos(turn))[near]
    return float(np.sqrt(np.mean((along - np.polyval(np.polyfit(across, along, 1), across)) ** 2)))


def _doubt_poses(facts: dict[str, Any]) -> list[Warned]:
    result = []
    if str(facts.get("calibration", "")).startswith("none"):
        result.append(Warned(
            Code.CALIBRATION,
            "--control came without --calibration, so the prism was taken for the LiDAR itself: the whole scene is "
            "off by the distance between the two; --calibration x,y,z tells it",
        ))  # fmt: skip
    if facts.get("clock_doubt"):
        result.append(Warned(Code.CLOCK, str(facts["clock_doubt"])))
    if facts.get("pose_doubt"):
        result.append(Warned(Code.POSES, str(facts["pose_doubt"])))
    if "nothing measured" in str(facts.get("length_fixed_by", "")):
        result.append(Warned(Code.LENGTH, "nothing measured the length: along smooth walls LiDAR odometry does not"))
    return result


def _doubt_rounding(facts: dict[str, Any]) -> list[Warned]:
    step = float(facts.get("rounded_to", 0.0))
    return [Warned(
        Code.ROUNDED,
        f"the coordinates of the cloud are rounded to {100 * step:.1f} cm, and the wall is known no better: 32-bit "
        "numbers far from the origin do so; export it with an offset, in 64 bits or with more digits",
    )] if step else []  # fmt: skip


def _tell_standard(bore: Bore, provenance: dict[str, str]) -> list[Warned]:
    if provenance.get("pockets") != "by standard" or not len(bore.pocket):
        return []
    return [Warned(
        Code.BY_STANDARD,
        f"the returns can show neither ring joints nor pockets, so {len(bore.ring_station)} rings and "
        f"{len(bore.pocket)} pockets stand where a standard lining has them, and none of them was seen; "
        "--lining none leaves them out",
    )]  # fmt: skip


_EVEN = 0.05  # m rms: a section that differs less from itself upside down has neither floor nor crown
_GUESSED = "longest along z"  # as `scene.reading.source` says it


def doubt_shaft(bore: Bore, axes: str) -> list[Warned]:
    """Warn of a guess that y is up; refuse the bore where its section is the same upside down, as that of a shaft.

    `axes` says which were taken, and why, as the manifest has it.
    """
    if _GUESSED not in axes:
        return []
    section = np.median(bore.radius, axis=0)
    turned = np.interp(-bore.angle, bore.angle, section, period=2 * np.pi)
    even = float(np.sqrt(np.mean((section - turned) ** 2))) < _EVEN
    size = f"{bore.length:.0f} m along z and {bore.width.mean():.1f} m across"
    if even:
        return [Warned(
            Code.SHAFT,
            f"no tunnel in the cloud but a vertical shaft, {size}: its section has neither floor nor crown; if it is a "
            "tunnel, --axes x-zy says that y is up in the file",
            refuses=True,
        )]  # fmt: skip
    return [Warned(
        Code.AXES,
        f"the cloud is {size}, so y was taken as up; if it is a vertical shaft, it is no tunnel, and if z is up, "
        "--axes xyz says so",
    )]  # fmt: skip


_FEW = 0.5  # fraction of the sleepers seen: with fewer, their places are the spacing's

_THIN = "the returns on the floor are too few to show any, or their sleepers: a track is easily missed"


def doubt_track(track: Track, seen: SeenTrack, pose_doubt: str | None = None) -> list[Warned]:
    """Return what nobody saw of a track that the survey shows in part, or could not show; a ring survey can show none.

    `pose_doubt` is the sentence on poses that blur the walls; `None` where they do not.
    """
    sought = track.config.lay == "auto" and seen.sought
    if sought and all(line.rails is None for line in seen.lines) and (pose_doubt or seen.thin):
        why = f"{pose_doubt}: rails blur as the walls do, and may be there" if pose_doubt else _THIN
        return [Warned(Code.RAILS, f"no rails were seen, but {why}; --track standard lays a track")]
    left_out = sum(line.left_out for line in track.lines)
    if left_out:
        return [Warned(
            Code.SLEEPERS,
            f"{left_out} sleepers are left out: {track.config.sleeper_length:g} m long, they would come within "
            f"{track.config.margin:g} m of a wall; --track.sleeper-length gives them the length that is there",
        )]  # fmt: skip
    if track.config.lay != "auto" or not seen.sought or len(seen.lines) != len(track.lines):
        return []
    count, measured = len(track.measured), int(track.measured.sum())
    if not count or measured >= _FEW * count:
        return []
    lines = [line.sleeper_station for line in track.lines if len(line.sleeper_station) > 1]
    spacing = sum(line[-1] - line[0] for line in lines) / max(sum(len(line) - 1 for line in lines), 1)
    observed = "none of them was seen" if not measured else f"only {measured} of them were seen"
    return [Warned(
        Code.SLEEPERS,
        f"{count} sleepers lie where a spacing of {spacing:.2f} m asks for them, and {observed}: the returns "
        "between the rails are too few, or lie too even, to tell them; --track none leaves the track out",
    )]  # fmt: skip
