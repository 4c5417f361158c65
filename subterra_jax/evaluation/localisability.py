"""Information of a scan about where a robot is, its bound, and the drift that a perfect filter keeps.

A scan holds ranges with independent normal noise, so its Fisher information about a pose is the sum over the beams of
g gᵀ / σ², with g the slope of a range over station, offset and heading.

Ranges jump at edges, where they have no slope, and the information of a point would be 0 beside an edge and infinite
at it. So the slope is that of the best straight line through the ranges of poses about the point, which are normally
distributed with a standard deviation `blur` (statistical linearisation), and what the line leaves over counts as
noise: g = Cov(r, x) / Var(x) and v = Var(r) − g² Var(x), each beam counts g gᵀ / (σ² + v). Where ranges are smooth this
is the plain Fisher information; a jump of height h counts, on average over stations, as a slope of h over some `blur`.
It answers a filter that knows its station to about `blur`, no other. So the drift of a perfect filter takes at each
place the blur that this filter has there itself, but no less than `blur`: it reads edges that it cannot tell apart as
the noise that they are to it.

Maps are chains of chords, which a filter must not read: slopes over the station below `LEAST_SLOPE` count as none.

Source: Särkkä 2013, Bayesian Filtering and Smoothing, section 5 (statistical linearisation); Tichavský et al. 1998,
IEEE Transactions on Signal Processing 46 (the recursion of the posterior bound).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax import lidar, lidar3d
from subterra_jax.evaluation.floor import filter_variance
from subterra_jax.state import EnvParams
from subterra_jax.tunnel import Tunnel, beside
from subterra_jax.tunnel.plan import TunnelPlan

BLUR = 0.05  # m
WIDER = (1.0, 2.0, 4.0, 8.0, 16.0)  # blurs for the drift, in units of the first
LEAST_SLOPE = (
    0.005  # 1: a range that changes by less than 5 mm a metre of station says more of the map than of the wall
)
# Blur of the heading, rad: about what scans tell of it. With 20 mrad a beam of 20 m ends half a metre aside, where the
# wall of a bend has another slope, and the heading no longer explains what a shift does.
_TURN = 0.003
_REACH = 4  # standard deviations to which the blur is carried
_BATCH = 2048  # poses cast at once
_POSES = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # offset and heading, in units of their blur


@dataclasses.dataclass(frozen=True)
class Localisability:
    """Bounds on what scans tell of a pose, by station; `inf` where they tell nothing.

    Attributes:
        station: Middles of the cells of station, m, `(n,)`.
        information: Fisher information of one scan about station (m), offset (m) and heading (rad), mean over the cell,
            `(n, 3, 3)`.
        station_bound: Cramér–Rao bound of one scan for the station, with offset and heading unknown too, by the mean of
            what the scans of the cell tell, m, `(n,)`.
        offset_bound: Bound of the offset, m.
        heading_bound: Bound of the heading, rad.
        drift: Standard deviation of the station that a perfect filter with the map keeps. It starts at the task's
            start, drives to the far mouth at full speed, and has commands, odometry and every scan, m, `(n,)`. A scan
            tells it as much as it tells a filter as uncertain, of at least `blur` and at most 16 times that.
        blind_drift: Drift without scans, m, `(n,)`.
    """

    station: Float[np.ndarray, " n"]
    information: Float[np.ndarray, "n 3 3"]
    station_bound: Float[np.ndarray, " n"]
    offset_bound: Float[np.ndarray, " n"]
    heading_bound: Float[np.ndarray, " n"]
    drift: Float[np.ndarray, " n"]
    blind_drift: Float[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True)
class Solid:
    """A LiDAR in three dimensions.

    Attributes:
        relief: Surface of the bore.
        plan: The tunnel, for its elevation.
        beams: Beams in the sensor's frame, unit vectors, `(n_beams, 3)`.
        height: Height of the sensor above the ground, m; `None` is the plan's LiDAR height.
    """

    relief: lidar3d.Relief
    plan: TunnelPlan
    beams: Float[np.ndarray, "n_beams 3"]
    height: float | None = None


def localisability(
    params: EnvParams, *, index: int = 0, step: float = 0.5, blur: float = BLUR, solid: Solid | None = None
) -> Localisability:
    """Compute how well the walls tell the pose of a robot in the middle that faces along the axis.

    Args:
        params: A task: its tunnel, the LiDAR's noise and range, the errors of commands and odometry.
        index: Number of the tunnel in a stack.
        step: Length of a cell of station, m.
        blur: Standard deviation of the poses about each point, m; see the module.
        solid: A LiDAR in three dimensions in place of the planar one, of the same noise and range.

    Raises:
        ValueError: `index`, `step` or `blur` is out of range.
    """
    count = params.tunnel.count
    if not 0 <= index < count:
        raise ValueError(f"there is no tunnel {index} in a stack of {count}")
    if not (blur > 0.0 and step >= blur):
        raise ValueError(f"blur must be above 0 and step at least as large, got blur={blur:g} m and step={step:g} m")
    tunnel = params.tunnel.pick(index)
    length = float(tunnel.length)
    cast = _caster(_planar(tunnel, params) if solid is None else _spatial(params, solid), tunnel)
    n = max(1, round(length / step))
    sigma = float(np.max(params.lidar.range_sigma))
    blurs = tuple(blur * factor for factor in WIDER)
    cells = [_cell_information(cast, length, n, one, blur, sigma) for one in blurs]
    station = (np.arange(n) + 0.5) * length / n
    with np.errstate(divide="ignore"):
        along, aside, turned = cells[0].told.T ** -0.5
    seen = filter_variance(station, np.stack([cell.told[:, 0] for cell in cells], axis=-1), params, blurs)
    blind = filter_variance(station, np.zeros(n), params)
    return Localisability(station, cells[0].information, along, aside, turned, np.sqrt(seen), np.sqrt(blind))


@dataclasses.dataclass(frozen=True)
class _Cells:
    """Mean of what one scan tells in each cell."""

    information: Float[np.ndarray, "n 3 3"]  # fisher information about station, offset and heading, `(n, 3, 3)`
    # Information about each of the three with the others unknown, `(n, 3)`. The mean is taken last: each scan has an
    # offset and a heading of its own, and the mean matrix would be that of one pose for all of a cell.
    told: Float[np.ndarray, "n 3"]


def _cell_information(
    cast: Callable[[np.ndarray, float, float], Float[np.ndarray, "n beams"]],
    length: float,
    n: int,
    blur: float,
    offset: float,
    sigma: float,
) -> _Cells:
    """Return the mean information of one scan over each of `n` cells.

    The blur of the offset stays as it is where that of the station grows, and that of the heading is always the same:
    walls tell them anywhere.
    """
    spacing = 0.5 * min(blur, length / n)
    fine = np.linspace(0.0, length, round(length / spacing) + 1)
    ranges = [cast(fine, aside * offset, heading * _TURN) for aside, heading in _POSES]
    information = scan_information(ranges, fine[1], blur, _TURN, sigma, offset)
    cell = np.minimum((fine / length * n).astype(int), n - 1)
    told = np.stack([marginal_bound(information, i) ** -2.0 for i in range(3)], axis=-1)

    count = np.bincount(cell, minlength=n)[:, None]

    def mean(each: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell, column, n) for column in each.T], axis=-1) / count

    return _Cells(mean(information.reshape(len(fine), 9)).reshape(n, 3, 3), mean(told))


def scan_information(
    ranges: list[Float[np.ndarray, "n n_beams"]],
    step: float,
    blur: float,
    turn: float,
    sigma: float,
    offset: float | None = None,
) -> Float[np.ndarray, "n 3 3"]:
    """Compute the information of a scan at each station, by statistical linearisation.

    Args:
        ranges: Ranges at uniform stations: in the middle, at an offset of ± `offset`, and turned by ± `turn`, m.
        step: Step of the stations, m.
        blur: Standard deviation of the station, m.
        turn: Standard deviation of the heading, rad.
        sigma: Standard deviation of a range, m.
        offset: Standard deviation of the offset, m; None is `blur`.
    """
    reach = int(np.ceil(_REACH * blur / step))
    at = step * np.arange(-reach, reach + 1)
    weight = np.exp(-0.5 * (at / blur) ** 2)
    weight /= weight.sum()
    variance = float(np.sum(weight * at * at))  # of the station, on this grid

    def blurred(values: np.ndarray, kernel: np.ndarray) -> np.ndarray:
        padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
        return sum(k * padded[i : i + len(values)] for i, k in enumerate(kernel))

    middle, aside_by = ranges[0], blur if offset is None else offset
    mean = blurred(middle, weight)
    # About the mean of the beam: squares of ranges would lose the digits of a small variance.
    level = middle.mean(axis=0)
    second = blurred((middle - level) ** 2, weight) - (mean - level) ** 2
    along = blurred(middle, weight * at) / variance
    aside, turned = (
        blurred(ranges[i] - ranges[i + 1], weight) / (2.0 * size) for i, size in ((1, aside_by), (3, turn))
    )
    left_over = np.maximum(second - along**2 * variance, 0.0)
    slope = np.stack([np.where(np.abs(along) < LEAST_SLOPE, 0.0, along), aside, turned], axis=-1)
    return np.einsum("nbi,nbj,nb->nij", slope, slope, 1.0 / (sigma**2 + left_over))


def marginal_bound(information: Float[np.ndarray, "n 3 3"], which: int) -> Float[np.ndarray, " n"]:
    """Compute the Cramér–Rao bound of one unknown where the others are unknown too; `inf` without information."""
    others = [i for i in range(3) if i != which]
    cross = information[:, others, which]
    rest = information[:, others][:, :, others]
    # Offset and heading of a pose between walls are always told; a hair keeps the inverse finite where nothing is.
    rest = rest + 1e-9 * np.eye(2)
    own = information[:, which, which] - np.einsum("ni,nij,nj->n", cross, np.linalg.inv(rest), cross)
    known = own > 1e-12 * np.maximum(information[:, which, which], 1e-12)
    return np.where(known, 1.0 / np.sqrt(np.where(known, own, 1.0)), np.inf)


Cast = Callable[[Array, Array, Array], Array]  # position, heading and station to ranges


def _planar(tunnel: Tunnel, params: EnvParams) -> Cast:
    return lambda position, heading, station: lidar.scan(tunnel, position, heading, station, params.lidar)


def _spatial(params: EnvParams, solid: Solid) -> Cast:
    """Cast of a level sensor that follows the grade of the ground."""
    plan, range_max = solid.plan, float(np.max(params.lidar.range_max))
    height = plan.lidar_height if solid.height is None else solid.height
    grid, ground = jnp.asarray(plan.station, jnp.float32), jnp.asarray(plan.elevation + height, jnp.float32)
    grade = jnp.asarray(np.gradient(plan.elevation, plan.station), jnp.float32)
    beams = jnp.asarray(solid.beams, jnp.float32)

    def cast(position: Array, heading: Array, station: Array) -> Array:
        place = jnp.append(position, jnp.interp(station, grid, ground))
        pitch = -jnp.arctan(jnp.interp(station, grid, grade))
        yaw_w, yaw_z, nod_w, nod_y = (f(0.5 * angle) for angle in (heading, pitch) for f in (jnp.cos, jnp.sin))
        turn = jnp.stack([yaw_w * nod_w, -yaw_z * nod_y, yaw_w * nod_y, yaw_z * nod_w])
        return lidar3d.scan(solid.relief, place, turn, station, beams, range_max)

    return cast


def _caster(take: Cast, tunnel: Tunnel) -> Callable[[np.ndarray, float, float], Float[np.ndarray, "n beams"]]:
    """Cast at stations along the axis, beside it and turned, in float64; one program for all."""

    @jax.jit
    def many(stations: Array, offset: Array, turn: Array) -> Array:
        def one(s: Array) -> Array:
            position, ahead = beside(tunnel, s, offset)
            return take(position, ahead + turn, s)

        return jax.vmap(one)(stations)

    def cast(station: np.ndarray, offset: float, turn: float) -> np.ndarray:
        padded = np.pad(station, (0, -len(station) % _BATCH), mode="edge").astype(np.float32).reshape(-1, _BATCH)
        rows = [np.asarray(many(some, np.float32(offset), np.float32(turn))) for some in padded]
        return np.concatenate(rows).astype(np.float64)[: len(station)]

    return cast
