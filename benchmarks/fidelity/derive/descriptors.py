"""Ranges by direction in the tunnel: what a scan looks like, real and synthetic."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from benchmarks.fidelity.case import Case, derived, of_hold
from benchmarks.fidelity.derive.beams import noisy, returns
from benchmarks.fidelity.derive.path import sensor_path

_SECTORS = (12, 4)  # of azimuth and elevation
_QUANTILES = (5, 25, 50, 75, 95)


@dataclass(frozen=True)
class Directions:
    """Of every returned beam, relative to the tunnel at the sensor.

    Attributes:
        azimuth: From the tunnel's axis ahead, to the left, rad, `(n,)`.
        elevation: rad, `(n,)`.
    """

    azimuth: Float[np.ndarray, " n"]
    elevation: Float[np.ndarray, " n"]


@of_hold
def directions(case: Case) -> Directions:
    """Azimuth and elevation of the held-out returns' beams."""
    real, path = returns(case), sensor_path(case)
    _, starts = np.unique(real.scan, return_index=True)
    tangent, left, up = path.frames(path.local(real.origin[starts])[:, 0])[1:]
    number = np.searchsorted(real.scan[starts], real.scan)
    ahead, aside, above = (np.einsum("ij,ij->i", axis[number], real.direction) for axis in (tangent, left, up))
    return Directions(np.arctan2(aside, ahead), np.arcsin(np.clip(above, -1.0, 1.0)))


@derived
def scan_descriptors(case: Case) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s d"], Int[np.ndarray, " s"]]:
    """Descriptors of the scans, real and synthetic, and the number of each scan.

    A descriptor holds quantiles of the ranges and their median in sectors of azimuth and elevation, in log metres; a
    sector without beams in either holds the scan's median.
    """
    real, seen = returns(case), directions(case)
    reach = noisy(case, "first")
    both = np.isfinite(reach)
    sector = np.zeros(len(reach), int)
    for angle, count in zip((seen.azimuth, seen.elevation), _SECTORS, strict=True):
        edges = np.quantile(angle, np.linspace(0.0, 1.0, count + 1)[1:-1])
        sector = sector * count + np.searchsorted(edges, angle)
    rows: list[tuple[np.ndarray, np.ndarray]] = []
    numbers = np.unique(real.scan)
    bounds = np.searchsorted(real.scan, np.append(numbers, numbers[-1] + 1))
    for start, end in itertools.pairwise(bounds):
        kept = np.flatnonzero(both[start:end]) + start
        if len(kept) > np.prod(_SECTORS):
            pair = (_described(np.maximum(r[kept], 0.01), sector[kept]) for r in (real.range, reach))
            rows.append(tuple(pair))  # type: ignore[arg-type]
    if len(rows) < 10:
        raise ValueError(f"{len(rows)} scans with returns from the candidate are too few to tell apart")
    left, right = zip(*rows, strict=True)
    return np.asarray(left), np.asarray(right), np.arange(len(rows))


def _described(reach: Float[np.ndarray, " n"], sector: Int[np.ndarray, " n"]) -> Float[np.ndarray, " d"]:
    log = np.log(reach)
    quantiles = np.percentile(log, _QUANTILES)
    parts = np.full(int(np.prod(_SECTORS)), quantiles[len(quantiles) // 2])
    order = np.argsort(sector, kind="stable")
    groups, starts = np.unique(sector[order], return_index=True)
    parts[groups] = [np.median(group) for group in np.split(log[order], starts[1:])]
    return np.concatenate([quantiles, parts])
