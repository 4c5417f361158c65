"""Procedural tunnels with known geometry, written as the files that the simulator reads.

The centreline is integrated from a curvature profile, the walls are offset from it along its normal, and everything is
float64 NumPy that shares no code with the simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

RING_PITCH = 1.5
POCKET_LENGTH = 0.2
POCKET_DEPTH = 0.13


def straight(length: float) -> list[tuple[float, float]]:
    """Curvature profile of a straight tunnel: `(length, curvature)` pieces, m and 1/m."""
    return [(length, 0.0)]


def arc(length: float, radius: float) -> list[tuple[float, float]]:
    """Curvature profile of one bend to the left (to the right for a negative radius)."""
    return [(length, 1.0 / radius)]


def s_bend(length: float, radius: float, lead: float = 20.0) -> list[tuple[float, float]]:
    """Straight lead, bend left, straight, bend right, straight lead."""
    bend = (length - 3.0 * lead) / 2.0
    return [(lead, 0.0), (bend, 1.0 / radius), (lead, 0.0), (bend, -1.0 / radius), (lead, 0.0)]


def _curvature(pieces: Sequence[tuple[float, float]], station: np.ndarray, transition: float) -> np.ndarray:
    """Curvature at each station, the steps between pieces smoothed over `transition` metres."""
    ends = np.cumsum([length for length, _ in pieces])
    kappa = np.array([k for _, k in pieces])
    fine = np.arange(-transition / 2, transition / 2 + 1e-9, 0.05)
    samples = station[:, None] + fine[None, :]
    return kappa[np.clip(np.searchsorted(ends, samples), 0, len(kappa) - 1)].mean(axis=1)


def _roughness(
    rng: np.random.Generator, station: np.ndarray, sigma: float, correlation: float, step: float = 0.05
) -> np.ndarray:
    """Gaussian wall roughness with the given standard deviation (m) and correlation length (m)."""
    grid = np.arange(station[0] - 5 * correlation, station[-1] + 5 * correlation + step, step)
    width = correlation / np.sqrt(2.0)
    kernel = np.exp(-0.5 * (np.arange(-4 * width, 4 * width + step, step) / width) ** 2)
    noise = np.convolve(rng.standard_normal(len(grid)), kernel / np.sqrt(np.sum(kernel**2)), mode="same")
    return sigma * np.interp(station, grid, noise)


class Plan:
    """Analytic centreline: position and unit tangent at any station."""

    def __init__(self, pieces: Sequence[tuple[float, float]], transition: float = 4.0):
        self.length = float(sum(length for length, _ in pieces))
        n = int(np.ceil(self.length / 0.01)) + 1
        self._s = np.linspace(0.0, self.length, n)
        kappa = _curvature(pieces, self._s, transition)
        step = self._s[1] - self._s[0]
        self._heading = np.concatenate([[0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1]) * step)])
        mid = 0.5 * (self._heading[1:] + self._heading[:-1])
        self._x = np.concatenate([[0.0], np.cumsum(np.cos(mid) * step)])
        self._y = np.concatenate([[0.0], np.cumsum(np.sin(mid) * step)])

    def centre(self, station: np.ndarray) -> np.ndarray:
        """Position at `station`, m, `(n, 2)`."""
        return np.stack([np.interp(station, self._s, self._x), np.interp(station, self._s, self._y)], axis=-1)

    def tangent(self, station: np.ndarray) -> np.ndarray:
        """Unit tangent at `station`, `(n, 2)`."""
        heading = np.interp(station, self._s, self._heading)
        return np.stack([np.cos(heading), np.sin(heading)], axis=-1)

    def point(self, station: np.ndarray, lateral: np.ndarray) -> np.ndarray:
        """The point `lateral` metres to the left of the centreline at `station`."""
        tangent = self.tangent(station)
        normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
        return self.centre(station) + np.asarray(lateral)[..., None] * normal


def _with_pockets(station: np.ndarray, offset: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut a pair of pockets at every ring joint into a wall given as (station, distance from the centreline)."""
    joints = np.arange(RING_PITCH, length - RING_PITCH / 2, RING_PITCH)
    starts = np.sort(np.concatenate([joints - 0.3, joints + 0.1]))
    ends = starts + POCKET_LENGTH
    inside = np.zeros(len(station), bool)
    for a, b in zip(starts, ends, strict=True):
        inside |= (station >= a - 1e-6) & (station <= b + 1e-6)
    a_offset, b_offset = np.interp(starts, station, offset), np.interp(ends, station, offset)
    corner_station = np.stack([starts, starts, ends, ends], axis=1).ravel()
    corner_offset = np.stack([a_offset, a_offset + POCKET_DEPTH, b_offset + POCKET_DEPTH, b_offset], axis=1).ravel()
    all_station = np.concatenate([station[~inside], corner_station])
    all_offset = np.concatenate([offset[~inside], corner_offset])
    order = np.argsort(all_station, kind="stable")
    return all_station[order], all_offset[order]


def tunnel_arrays(
    pieces: Sequence[tuple[float, float]],
    *,
    half_width: float = 2.825,
    roughness: float = 0.0,
    correlation: float = 1.0,
    wall_step: float = 0.25,
    centre_step: float = 0.25,
    seed: int = 0,
    name: str = "procedural",
    transition: float = 4.0,
    pockets: bool = True,
) -> dict[str, Any]:
    """The arrays of a `tunnel.npz`.

    Args:
        pieces: `(length, curvature)` of each piece of the centreline, m and 1/m.
        half_width: Half the distance between the walls, m.
        roughness: Standard deviation of the walls about their smooth curve, m.
        correlation: Length over which that roughness stays alike, m.
        wall_step: Distance between wall vertices, m.
        centre_step: Needed spacing of the chainage grid, m.
        seed: Seed of the roughness.
        name: Name in the file.
        transition: Length over which the curvature changes from piece to piece, m.
        pockets: Whether the lining "pockets" has any.

    Returns:
        Field name to array.
    """
    plan = Plan(pieces, transition)
    rng = np.random.default_rng(seed)
    station = np.linspace(0.0, plan.length, round(plan.length / centre_step) + 1)
    wall_station = np.linspace(0.0, plan.length, round(plan.length / wall_step) + 1)
    arrays: dict[str, Any] = {
        "schema": "subterra.tunnel/3",
        "name": name,
        "provenance": "simulated",
        "station": station,
        "centre": plan.centre(station),
        "tangent": plan.tangent(station),
        "elevation": np.zeros(len(station)),
        "half_width": np.full(len(station), half_width),
        "lidar_height": np.array(0.6),
        "lining": np.array(["smooth", "pockets"]),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        offset = np.full(len(wall_station), half_width)
        if roughness > 0.0:
            offset = offset + _roughness(rng, wall_station, roughness, correlation)
        pocket_station, pocket_offset = wall_station, offset
        if pockets:
            pocket_station, pocket_offset = _with_pockets(wall_station, offset, plan.length)
        for lining, s, d in (("smooth", wall_station, offset), ("pockets", pocket_station, pocket_offset)):
            arrays[f"{side}_{lining}"] = plan.point(s, sign * d)
            arrays[f"{side}_station_{lining}"] = s
    for lining in ("smooth", "pockets"):
        arrays[f"furniture_{lining}"] = np.zeros((0, 4))
    return arrays


def write_tunnel(path: str | Path, arrays: dict[str, Any]) -> Path:
    """Write `arrays` as a tunnel file and return its path."""
    path = Path(path)
    np.savez_compressed(path, **arrays)
    return path


def write_corridor(path: str | Path, length: float) -> Path:
    """Write a straight tunnel 4 m wide whose walls are plain in either lining, and return its path."""
    return write_tunnel(
        path, tunnel_arrays(straight(length), half_width=2.0, wall_step=0.5, centre_step=0.5, pockets=False)
    )


def provisional() -> dict[str, Any]:
    """A 351 m stand-in for the reconstructed bore: two S-bends of about 300 m radius, 1.5 cm of roughness."""
    pieces = [(30.0, 0.0), (70.0, 1 / 300), (35.0, 0.0), (75.0, -1 / 320), (31.0, 0.0), (70.0, 1 / 300), (40.0, 0.0)]
    return tunnel_arrays(pieces, roughness=0.015, correlation=1.0, name="provisional")
