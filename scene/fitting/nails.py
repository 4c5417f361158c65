"""Nails: the bolts across a ring joint, seen in the two pockets that they join.

Inside a pocket the nail hangs free between wall and back. Returns from the middle of the mouth at that depth come from
it or from nothing; the rim, the sides and the back lie elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial import cKDTree

from scene.bore import NAIL, Bore
from scene.cloud import Cloud

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
    """What the cloud says of each pair.

    Attributes:
        present: A nail was seen, `(b,)`.
        absent: The backs were seen and no nail in front of them, `(b,)`.
        confidence: Probability that what was counted is no chance, `(b,)`.
        depth: Of the nails' axes behind the wall, m, median over all.
    """

    present: Bool[np.ndarray, " b"]
    absent: Bool[np.ndarray, " b"]
    confidence: Float[np.ndarray, " b"]
    depth: float


def pairs(bore: Bore) -> Int[np.ndarray, "b 2"]:
    """Pockets of one row on both sides of one joint, as indices into `bore.pocket`, each used once."""
    pocket = bore.pocket
    if len(pocket) < 2:
        return np.empty((0, 2), np.intp)
    order = np.argsort(pocket["station"], kind="stable")
    station, angle = pocket["station"][order], pocket["angle"][order]
    across = float(np.median(bore.radius))
    free, result = np.ones(len(order), bool), []
    for k in range(len(order)):
        if not free[k]:
            continue
        last = int(np.searchsorted(station, station[k] + _APART[1]))
        ahead = np.arange(k + 1, last)
        turn = np.abs(np.angle(np.exp(1j * (angle[ahead] - angle[k])))) * across
        fit = ahead[free[ahead] & (turn < _SAME_ROW) & (station[ahead] - station[k] > _APART[0])]
        if len(fit):
            free[k] = free[fit[0]] = False
            result.append((order[k], order[fit[0]]))
    return np.array(result, np.intp).reshape(-1, 2)


def laid(bore: Bore, pair: Int[np.ndarray, "b 2"], depth: float, diameter: float) -> Shaped[np.ndarray, " b"]:
    """Nails from the middle of one pocket to that of the other, of `scene.bore.NAIL`, not measured."""
    first, second = bore.pocket[pair[:, 0]], bore.pocket[pair[:, 1]]
    result = np.zeros(len(pair), NAIL)
    result["station"] = (first["station"] + second["station"]) / 2
    result["angle"] = np.angle(np.exp(1j * first["angle"]) + np.exp(1j * second["angle"]))
    result["length"] = second["station"] - first["station"]
    result["diameter"], result["depth"] = diameter, depth
    return result


def seen(bore: Bore, pair: Int[np.ndarray, "b 2"], cloud: Cloud) -> SeenNails | None:
    """Which pairs a nail joins, or `None` where the cloud cannot tell.

    It can where the backs of the pockets are seen as often as a nail in front of them would be.
    """
    if not len(pair):
        return None
    count, depth, backs = _counts(bore, cloud)
    on_pair = count[pair].sum(axis=1)
    on_back = backs[pair].sum(axis=1)
    if max(float(on_pair.mean()), float(on_back.mean())) < _USUAL:
        return None
    present = on_pair >= _MIN_POINTS
    behind = float(np.nanmedian(depth[pair[present]])) + _FRONT * _RADIUS if present.any() else 0.0
    absent = ~present & (on_pair == 0) & (on_back >= _MIN_BACKS)
    return SeenNails(present, absent, 1 - np.exp(-on_pair), behind)


def _counts(bore: Bore, cloud: Cloud) -> tuple[Int[np.ndarray, " p"], Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Of each pocket: points where a nail would hang, their median depth, m, and points further back."""
    pocket, axis = bore.pocket, bore.axis
    at = axis.at(pocket["station"])
    row = np.clip(np.rint(pocket["station"] / bore.station[1]).astype(np.intp), 0, len(bore.station) - 1)
    radius = np.array([
        np.interp(a, bore.angle, bore.radius[k], period=2 * np.pi) for a, k in zip(pocket["angle"], row, strict=True)
    ])  # fmt: skip
    lateral, up = np.cos(pocket["angle"])[:, None] * at.lateral, np.sin(pocket["angle"])[:, None] * at.up
    middle = at.position + radius[:, None] * (lateral + up)
    near = cKDTree(cloud.points).query_ball_point(middle, np.hypot(_REACH, pocket["depth"].max()))
    count, backs = np.zeros(len(pocket), np.intp), np.zeros(len(pocket), np.intp)
    depth = np.full(len(pocket), np.nan)
    for k, rows in enumerate(near):
        outward = _normal(bore, row[k], float(pocket["angle"][k]))
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


def _normal(bore: Bore, row: int, angle: float) -> Float[np.ndarray, "3"]:
    """Outward unit normal of the section over 10°."""
    turn = angle + np.deg2rad([-5.0, 5.0])
    radius = np.interp(turn, bore.angle, bore.radius[row], period=2 * np.pi)
    y, z = np.diff(radius * np.cos(turn))[0], np.diff(radius * np.sin(turn))[0]
    return (z * bore.lateral[row] - y * bore.up[row]) / np.hypot(y, z)
