"""What the environment's planar scan can tell about its place along the tunnel."""

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.fidelity.case import Case, derived

BEAMS = 16
SIGMA = 0.05  # m, of a range; the environment's default
REACH = 30.0  # m
LOCALISED = 0.25  # m: standard deviation along the axis from which on a station counts as localised
_SPACING = 1.0  # m


@derived
def localised(case: Case) -> Bool[np.ndarray, " s"]:
    """For each metre of `tunnel.npz` whether 16 beams on its axis fix the place along it.

    Shifted along the axis t, a range changes by (n·t)/(n·d) and its distance from the wall by n·t; the standard
    deviation of the shift is σ over the root of the sum of (n·t)² over the beams that return.
    """
    with np.load(case.candidate.tunnel) as data:
        lining = "pockets" if "left_pockets" in data else "smooth"
        walls = [data[f"{side}_{lining}"] for side in ("left", "right")]
        station, centre, tangent = (data[name] for name in ("station", "centre", "tangent"))
    start, end = (np.concatenate([wall[part] for wall in walls]) for part in (slice(None, -1), slice(1, None)))
    places = np.arange(station[0] + 0.5 * _SPACING, station[-1], _SPACING)
    centres, tangents = (np.stack([np.interp(places, station, a) for a in xy.T], axis=1) for xy in (centre, tangent))
    information = [_axial(c, t / np.linalg.norm(t), start, end) for c, t in zip(centres, tangents, strict=True)]
    return np.asarray(information) > (SIGMA / LOCALISED) ** 2


def _axial(
    place: Float[np.ndarray, "2"],
    tangent: Float[np.ndarray, "2"],
    start: Float[np.ndarray, "w 2"],
    end: Float[np.ndarray, "w 2"],
) -> float:
    """Sum of (n·t)² over the beams from a place."""
    near = np.minimum(np.linalg.norm(start - place, axis=1), np.linalg.norm(end - place, axis=1)) < REACH
    wall, offset = (end - start)[near], start[near] - place
    length = np.linalg.norm(wall, axis=1)
    wall, offset, length = wall[length > 0], offset[length > 0], length[length > 0]
    if not len(wall):
        return 0.0
    angle = np.arctan2(tangent[1], tangent[0]) + 2.0 * np.pi * np.arange(BEAMS) / BEAMS
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = _cross(beam[:, None], wall[None])
    across = np.where(np.abs(across) < 1e-12, np.nan, across)
    reach = _cross(offset[None], wall[None]) / across
    share = _cross(offset[None], beam[:, None]) / across
    reach = np.where((reach > 0.0) & (share >= 0.0) & (share <= 1.0), reach, np.inf)
    first = np.argmin(reach, axis=1)
    returned = reach[np.arange(BEAMS), first] < REACH
    return float(np.sum(np.square(_cross(wall[first], tangent) / length[first])[returned]))


def _cross(a: Float[np.ndarray, "... 2"], b: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
