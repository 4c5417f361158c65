"""Lining of segments: rings, pockets and nails, measured where the survey shows them, by standard where it cannot.

Nails are the bolts across a ring joint. Inside a pocket the nail hangs free between wall and back. Returns from the
middle of the mouth at that depth come from it or from nothing; the rim, the sides and the back lie elsewhere.

Universal rings by standard: each ring is turned to the place of its key segment, and its pockets turn with it.

Ring joints are dowelled and show nothing on the wall. Each radial joint is bolted at the middle of the ring; the bolt
shows a pocket on either side of the joint.

Sources:
    Five segments and a key: Bangkok's first line (tunnelbuilder.com, 1999) and Shanghai's line 13 (J. Tongji Univ.).
    Turns by whole places, so that dowels meet: Autodesk InfraWorks, bored ring tunnels (360° over the places).
    No straight joints from ring to ring: Advances in Civil Engineering 2021, 3606389 (Ningbo, line 2).
    16 places, 67.5° and 22.5°, one bolt a joint, dowels: engineering practice, from memory, not looked up.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Float, Int, Shaped
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from scene.bore import NAIL, POCKET, Bore
from scene.cloud import Cloud
from scene.fitting.pockets import FLOOR_MARGIN, could_show_pockets, find_pockets
from scene.fitting.section import Sections

N_PLACES = 16  # of the key segment around a ring
PLACE = 2.0 * np.pi / N_PLACES  # rad; the key is as wide
_JOINTS = np.array([0, 3, 6, 9, 12, 15])  # places after which a radial joint follows, from the key's begin
_STEPS = np.array([k for k in range(1, N_PLACES) if not set((_JOINTS + k) % N_PLACES) & set(_JOINTS.tolist())])
_SEGMENT = (0.8, 2.5)  # lengths of segments, m
_FEW = 4  # rings whose numbers tell those between
_ALONG, _ROUGH = 2.0, 0.03  # m of bore, and standard deviation of its wall: a rougher one is no lining of segments


def joints_by_number(names: list[str], station: Float[np.ndarray, " r"]) -> Float[np.ndarray, " j"]:
    """Return the ring joints of a survey of some rings, m: between two that were measured, rings are of one length.

    A ring is taken as measured at its middle. Only names that are whole numbers and grow, or fall, along the tunnel
    tell the rings between: all joints between the first and the last of them, none where the names tell nothing.
    """
    if len(names) < _FEW or not all(name.isdecimal() for name in names):
        return np.empty(0)
    number = np.array([int(name) for name in names])
    number = number if number[-1] > number[0] else -number
    if (np.diff(number) < 1).any():
        return np.empty(0)
    joints = np.interp(np.arange(number[0], number[-1]) + 0.5, number, station)
    width = np.diff(joints)
    return joints if len(width) and _SEGMENT[0] < width.min() and width.max() < _SEGMENT[1] else np.empty(0)


def draw_places(rng: np.random.Generator, count: int) -> Int[np.ndarray, " r"]:
    """Draw the place of each ring's key segment; no radial joint lies in line with one of the ring before."""
    first = rng.integers(N_PLACES, size=1)
    return np.mod(np.cumsum(np.concatenate([first, rng.choice(_STEPS, max(count - 1, 0))])), N_PLACES)[:count]


def radial_joints(seed: int, count: int) -> Float[np.ndarray, "r 6"]:
    """Return the angles of the radial joints of `count` rings, rad.

    The first bolt of the tunnel is drawn too, since nobody says where its designer has put it.
    """
    rng = np.random.default_rng(seed)
    begin = rng.uniform(0.0, PLACE)
    return begin + PLACE * (draw_places(rng, count)[:, None] + _JOINTS)


def place_pockets(
    joint: Float[np.ndarray, " j"], seed: int, offset: float
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return station, m, and angle, rad, of the pockets at the radial joints of all whole rings between joints, m.

    `offset` is the angle from a radial joint to the middle of a pocket, rad.
    """
    middle = 0.5 * (joint[1:] + joint[:-1])
    angle = radial_joints(seed, len(middle))[..., None] + offset * np.array([-1.0, 1.0])
    return np.broadcast_to(middle[:, None, None], angle.shape).ravel(), angle.ravel()


_APART = (0.25, 0.80)  # m between the middles of two pockets of a pair
_SAME_ROW = 0.12  # m around
_HALF = (0.05, 0.04)  # m along and around of the middle of the mouth
_DEPTHS = (0.30, 0.70)  # of the pocket's depth, between which a nail hangs
_MIN_POINTS = 2  # on a nail, in both pockets
_MIN_BACKS = 2  # points on the backs of a pair without a nail: it was seen, and there is none
_USUAL = 1.0  # points on a pair in the mean: with fewer, chance decides
_REACH = 0.12  # m around a pocket's middle
_FRONT = np.pi / 4  # of the radius: how far the seen half of a cylinder lies before its axis, in the mean
_RADIUS = 0.0135  # m


@dataclass(frozen=True)
class SeenNails:
    """Nails that the cloud shows in each pair of pockets."""

    present: Bool[np.ndarray, " b"]  # A nail was seen
    absent: Bool[np.ndarray, " b"]  # The backs were seen and no nail in front of them
    confidence: Float[np.ndarray, " b"]  # Probability that what was counted is no chance
    depth: float  # Median depth of the nails' axes behind the wall, m


def pair_pockets(bore: Bore, joint: Float[np.ndarray, " r"] | None = None) -> Int[np.ndarray, "b 2"]:
    """Pairs pockets of one row across one joint, as indices into `bore.pocket`, each used once.

    `joint` holds the ring joints, m, where they are known: without, any two at the distance of a pair are one.
    """
    pocket = bore.pocket
    if len(pocket) < 2:
        return np.empty((0, 2), np.intp)
    order = np.argsort(pocket["station"], kind="stable")
    station, angle = pocket["station"][order], pocket["angle"][order]
    across = float(np.median(bore.radius))
    ring = np.searchsorted(np.sort(joint), station) if joint is not None else None
    free, result = np.ones(len(order), bool), []
    for k in range(len(order)):
        if not free[k]:
            continue
        last = int(np.searchsorted(station, station[k] + _APART[1]))
        ahead = np.arange(k + 1, last)
        turn = np.abs(np.angle(np.exp(1j * (angle[ahead] - angle[k])))) * across
        fit = free[ahead] & (turn < _SAME_ROW) & (station[ahead] - station[k] > _APART[0])
        fit = ahead[fit if ring is None else fit & (ring[ahead] == ring[k] + 1)]
        if len(fit):
            free[k] = free[fit[0]] = False
            result.append((order[k], order[fit[0]]))
    return np.array(result, np.intp).reshape(-1, 2)


def make_nails(bore: Bore, pair: Int[np.ndarray, "b 2"], depth: float, diameter: float) -> Shaped[np.ndarray, " b"]:
    """Makes nails from the middle of one pocket to that of the other, marked as not measured."""
    first, second = bore.pocket[pair[:, 0]], bore.pocket[pair[:, 1]]
    result = np.zeros(len(pair), NAIL)
    result["station"] = (first["station"] + second["station"]) / 2
    result["angle"] = np.angle(np.exp(1j * first["angle"]) + np.exp(1j * second["angle"]))
    result["length"] = second["station"] - first["station"]
    result["diameter"], result["depth"] = diameter, depth
    return result


def find_nails(bore: Bore, pair: Int[np.ndarray, "b 2"], cloud: Cloud) -> SeenNails | None:
    """Finds the pairs that a nail joins; `None` where the cloud cannot tell.

    It can where the backs of the pockets are seen as often as a nail in front of them would be.
    """
    if not len(pair):
        return None
    count, depth, backs = _count_returns(bore, cloud)
    on_pair = count[pair].sum(axis=1)
    on_back = backs[pair].sum(axis=1)
    if max(float(on_pair.mean()), float(on_back.mean())) < _USUAL:
        return None
    present = on_pair >= _MIN_POINTS
    behind = float(np.nanmedian(depth[pair[present]])) + _FRONT * _RADIUS if present.any() else 0.0
    absent = ~present & (on_pair == 0) & (on_back >= _MIN_BACKS)
    return SeenNails(present, absent, 1 - np.exp(-on_pair), behind)


def _count_returns(
    bore: Bore, cloud: Cloud
) -> tuple[Int[np.ndarray, " p"], Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """For each pocket: points where a nail would hang, their median depth, m, and points further back."""
    pocket, axis = bore.pocket, bore.axis
    at = axis.at(pocket["station"])
    row = bore.row_of(pocket["station"])
    radius = np.array([
        np.interp(a, bore.angle, bore.radius[k], period=2 * np.pi) for a, k in zip(pocket["angle"], row, strict=True)
    ])  # fmt: skip
    lateral, up = np.cos(pocket["angle"])[:, None] * at.lateral, np.sin(pocket["angle"])[:, None] * at.up
    middle = at.position + radius[:, None] * (lateral + up)
    near = cKDTree(cloud.points).query_ball_point(middle, np.hypot(_REACH, pocket["depth"].max()))
    count, backs = np.zeros(len(pocket), np.intp), np.zeros(len(pocket), np.intp)
    depth = np.full(len(pocket), np.nan)
    for k, rows in enumerate(near):
        outward = _wall_normal(bore, row[k], float(pocket["angle"][k]))
        offset = cloud.points[rows].astype(np.float64) - middle[k]
        along, behind = offset @ at.tangent[k], offset @ outward
        around = offset @ np.cross(outward, at.tangent[k])
        mouth = (np.abs(along) < _HALF[0]) & (np.abs(around) < _HALF[1])
        low, high = np.array(_DEPTHS) * pocket["depth"][k]
        hanging = mouth & (behind > low - 0.01) & (behind < high)
        count[k], backs[k] = hanging.sum(), (mouth & (behind >= high)).sum()
        if hanging.any():
            depth[k] = np.median(behind[hanging])
    return count, depth, backs


def _wall_normal(bore: Bore, row: int, angle: float) -> Float[np.ndarray, "3"]:
    """Outward unit normal of the section over 10°."""
    turn = angle + np.deg2rad([-5.0, 5.0])
    radius = np.interp(turn, bore.angle, bore.radius[row], period=2 * np.pi)
    y, z = np.diff(radius * np.cos(turn))[0], np.diff(radius * np.sin(turn))[0]
    return (z * bore.lateral[row] - y * bore.up[row]) / np.hypot(y, z)


MEASURED, STANDARD, NONE = "measured", "by standard", "none found"


@dataclass(frozen=True)
class LiningConfig:
    """The lining that stands where the survey can show none."""

    # Lining that is put in where the survey could not show one and the walls are an even section: by standard where
    # the survey shows rails (auto), none, or by standard in any bore.
    lay: Annotated[Literal["auto", "none", "standard"], tyro.conf.arg(name="lining", prefix_name=False)] = "auto"
    # Rows of pockets across ring joints; or universal rings, each turned to the place of its key segment, with pockets
    # at the joints within a ring (scene/fitting/lining.py has the sources).
    kind: Literal["straight", "universal"] = "straight"
    seed: int = 0  # Seed of the turns of universal rings.
    # Width of a ring, m. Universal rings of a ring survey are as wide as their numbers tell. Source: 1.5 m, Guangzhou
    # line 21; 1.2–1.5 m in use.
    ring_width: float = 1.5
    # Pockets on each side of a joint, spread evenly over the crown between the lowest two. An assumption: metro rings
    # have 10 to 17 longitudinal bolts, the lowest below the track.
    pockets_per_ring: int = 8
    # Length along and width around, m. An assumption: openings of 0.15–0.25 m are usual.
    pocket_size: tuple[float, float] = (0.20, 0.18)
    pocket_depth: float = 0.13  # Depth of a pocket, m. Source: 13 cm, the paper, Sec. II.
    pocket_offset: float = 0.22  # Distance of a pocket's middle from the joint, m. An assumption.
    # Angle of the lowest pockets below the horizontal, rad. An assumption: where the plane of a robot's LiDAR meets the
    # wall in a section of 5.65 m × 6.36 m. In a round one of 5.8 m that is at 0.61; at 0.70 the plane passes between
    # two rows and the lining is smooth to the robot.
    clock_angle: float = 0.70
    # Angle below the horizontal beyond which universal rings show no pockets, rad. Ours: there a filling carries the
    # track.
    filled_angle: float = 0.90
    nail_diameter: float = 0.027  # Diameter of a nail, m. Source: bolts M24 to M30.
    nail_depth: float = 0.06  # Depth of its axis behind the wall, m. An assumption: mid-pocket.


_NO_JOINTS = np.empty(0)


def add_lining(
    bore: Bore,
    sections: Sections,
    cloud: Cloud | None = None,
    config: LiningConfig | None = None,
    railway: bool = False,
) -> tuple[Bore, dict[str, str]]:
    """Return a smooth bore with its lining, and the provenance of rings, pockets and nails.

    Nails are looked for in the cloud; without one they are by standard. `railway` tells whether the survey shows rails.
    """
    config = config or LiningConfig()
    measured, joints = find_pockets(sections)
    if len(measured):
        bore = replace(bore, pocket=measured, ring_station=joints)
        rings = MEASURED if len(joints) else "none: neither pockets nor steps of the wall tell the joints"
        return _add_nails(bore, cloud, config, {"rings": rings, "pockets": MEASURED}, joints)
    if could_show_pockets(sections, config.pocket_depth):
        return bore, {"rings": NONE, "pockets": NONE, "nails": NONE}
    return add_standard_lining(bore, config, sections.flat_floor, railway=railway)


def add_standard_lining(
    bore: Bore,
    config: LiningConfig,
    flat_floor: bool,
    joints: Float[np.ndarray, " j"] = _NO_JOINTS,
    railway: bool = False,
) -> tuple[Bore, dict[str, str]]:
    """Return a smooth bore with the lining of the configuration, marked as not measured; ring stations it has are kept.

    Nothing is put in where `config.lay` does not ask for it, or only for a `railway`, and this is none. A flat floor,
    the lowest part of the section, gets no pockets. `joints` are ring joints that the survey tells, m, between which
    universal rings stand.
    """
    needed = config.lay == "standard" or (config.lay == "auto" and railway)
    if config.kind == "universal" and needed:
        return _add_universal_lining(bore, config, flat_floor, joints)
    rings = {"rings": MEASURED} if len(bore.ring_station) else {"rings": STANDARD}
    joints = np.arange(config.ring_width / 2, bore.length, config.ring_width)
    joints = joints[_is_even(bore, joints)]
    rows = np.linspace(-config.clock_angle, np.pi + config.clock_angle, max(config.pockets_per_ring, 1))
    station = joints[:, None, None] + config.pocket_offset * np.array([-1.0, 1.0])[None, :, None] + 0 * rows
    pockets = _make_pockets(bore, station.ravel(), (rows + 0 * station).ravel(), config, flat_floor)
    if not needed or not len(pockets):
        provenance = rings if len(bore.ring_station) else {"rings": "none"}
        return bore, {**provenance, "pockets": "none: the survey cannot show them", "nails": "none"}
    bore = replace(bore, pocket=pockets, ring_station=bore.ring_station if len(bore.ring_station) else joints)
    return _add_nails(bore, None, config, {**rings, "pockets": STANDARD})


def _add_universal_lining(
    bore: Bore, config: LiningConfig, flat_floor: bool, given: Float[np.ndarray, " j"]
) -> tuple[Bore, dict[str, str]]:
    joints = given if len(given) else np.arange(config.ring_width / 2, bore.length, config.ring_width)
    offset = config.pocket_offset / float(bore.radius.mean())
    station, angle = place_pockets(joints, config.seed, offset)
    keep = _is_even(bore, station) & (np.sin(angle) > -np.sin(config.filled_angle))
    pockets = _make_pockets(bore, station[keep], angle[keep], config, flat_floor)
    surveyed = len(bore.ring_station) > 0
    if not len(pockets):
        none = {"pockets": "none: the survey cannot show them", "nails": "none"}
        return bore, {"rings": MEASURED if surveyed else "none", **none}
    joints = joints[_is_even(bore, joints)]
    bore = replace(bore, pocket=pockets, ring_joint=joints if surveyed else bore.ring_joint)
    return bore if surveyed else replace(bore, ring_station=joints), {
        "rings": f"{MEASURED}, those between by their numbers" if len(given) else MEASURED if surveyed else STANDARD,
        "pockets": f"{STANDARD}, turns drawn with seed {config.seed}",
        "nails": "none: ring joints by standard have dowels",
    }


def _is_even(bore: Bore, station: Float[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """Return where the section stays the same as far along as that of segments does."""
    reach = round(_ALONG / bore.station[1])
    wander = uniform_filter1d(bore.radius**2, reach, axis=0) - uniform_filter1d(bore.radius, reach, axis=0) ** 2
    rough = np.sqrt(np.maximum(np.median(wander, axis=1), 0.0)) > _ROUGH
    return ~rough[np.clip(np.searchsorted(bore.station, station), 0, len(bore.station) - 1)]


def _make_pockets(
    bore: Bore, station: Float[np.ndarray, " p"], angle: Float[np.ndarray, " p"], config: LiningConfig, flat_floor: bool
) -> Shaped[np.ndarray, " p"]:
    """Return pockets at these places by growing station, but none in a mouth or a flat floor."""
    angle = np.angle(np.exp(1j * angle))
    length, width = config.pocket_size
    keep = (station > length) & (station < bore.length - length)
    if flat_floor:
        keep &= _above_floor(bore, station, angle) > FLOOR_MARGIN
    pockets = np.zeros(int(keep.sum()), POCKET)
    pockets["station"], pockets["angle"], pockets["depth"] = station[keep], angle[keep], config.pocket_depth
    pockets["length"], pockets["width"] = length, width
    return pockets[np.lexsort((pockets["angle"], pockets["station"]))]


def _above_floor(bore: Bore, station: np.ndarray, angle: np.ndarray) -> Float[np.ndarray, " p"]:
    """Height of each place on the wall above the floor on the axis, m."""
    row = np.clip(np.searchsorted(bore.station, station), 0, len(bore.station) - 1)
    upward = bore.radius * np.sin(bore.angle)
    column = np.argmin(np.abs(np.angle(np.exp(1j * (angle[:, None] - bore.angle[None])))), axis=1)
    return upward[row, column] - upward[row].min(axis=1)


def _add_nails(
    bore: Bore,
    cloud: Cloud | None,
    config: LiningConfig,
    provenance: dict[str, str],
    joint: Float[np.ndarray, " r"] | None = None,
) -> tuple[Bore, dict]:
    pairs = pair_pockets(bore, joint)
    seen = find_nails(bore, pairs, cloud) if cloud is not None else None
    if seen is None:
        nails = make_nails(bore, pairs, config.nail_depth, config.nail_diameter)
        return replace(bore, nail=nails), {**provenance, "nails": STANDARD if len(pairs) else NONE}
    result = make_nails(bore, pairs, seen.depth if seen.present.any() else config.nail_depth, config.nail_diameter)
    result["measured"], result["confidence"] = seen.present, np.where(seen.present, seen.confidence, 0.0)
    if not seen.present.any():
        return bore, {**provenance, "nails": NONE}
    return replace(bore, nail=result[~seen.absent]), {**provenance, "nails": f"{MEASURED}, those not seen {STANDARD}"}
