"""A cloud in, the axis of the bore out: through mid-width and mid-height, smooth, with arc length.

The first guess comes from distances *along* the surface, so that no orientation or straightness is assumed; it is then
pulled to the middle of the sections a few times.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline

from scene.axis import Axis, through
from scene.errors import FitError
from scene.fitting import floor, profile
from scene.fitting.branches import require_no_fold
from scene.fitting.skeleton import skeleton

_HERE = np.zeros(3)
_OVERRUN = 6.0
_FULL_SHARE = 0.5
_SPACING = 1.0
_PASSES = 4
_COARSE_ANGLES = 72
_POINTS_PER_METRE = 5_000
_MIN_SEEN = 0.6
_FURTHEST = 2.0  # times the median radius of a section: further is a passage, which has no part in its middle
_ELONGATION = 1.6
_DOWN, _TRACK = -0.8, 0.5  # directions in which sleepers and rails may hide the bed, and how deep, m


@dataclass(frozen=True)
class CentrelineConfig:
    """How the axis is found.

    Attributes:
        min_length: A cloud shorter than this is refused, m.
        cutoff: Wavelength that smoothing halves, m; shorter waviness is the wall's, not the axis'.
    """

    min_length: float = 10.0
    cutoff: float = 12.0


def fit_centreline(
    points: Float[np.ndarray, "n 3"], config: CentrelineConfig, origin: Float[np.ndarray, "3"] = _HERE
) -> Axis:
    """The axis of the bore, from end to end of the cloud.

    Args:
        points: Registered cloud, z up, m.
        config: See `CentrelineConfig`.
        origin: Of the points' frame in the input's, m, so that an error can say where in the input.

    Raises:
        FitError: Too short, nothing like a tunnel, or with a branch or a room.
    """
    axis = _smooth(skeleton(points, config.min_length, origin), config.cutoff)
    stride = max(1, int(len(points) / (axis.length * _POINTS_PER_METRE)))
    sample = points[::stride].astype(np.float64)
    for _ in range(_PASSES):
        axis = _smooth(_middles(sample, axis), config.cutoff)
    if axis.length < config.min_length:
        raise FitError(f"the tunnel is {axis.length:.1f} m long; at least {config.min_length:g} m are needed")
    across = 2 * float(np.median(np.hypot(*axis.local(sample[:: max(1, len(sample) // 20_000)])[1:])))
    if axis.length < _ELONGATION * across:
        raise FitError(f"{axis.length:.0f} m long and {across:.0f} m across: a room, not a tunnel")
    require_no_fold(axis, across, origin)
    return axis


def _middles(points: np.ndarray, axis: Axis) -> Float[np.ndarray, "k 3"]:
    """Middle of each section seen well enough, one a metre."""
    extended = axis.at(np.arange(-_OVERRUN, axis.length + _OVERRUN, _SPACING))
    station, lateral, upward = extended.local(points)
    index = np.rint((station - extended.station[0]) / _SPACING).astype(np.intp)
    angle, radius = np.arctan2(upward, lateral), np.hypot(lateral, upward)
    bins = np.floor((angle + np.pi) / (2 * np.pi) * _COARSE_ANGLES).astype(np.intp) % _COARSE_ANGLES
    centres = profile.angles(_COARSE_ANGLES) + np.pi / _COARSE_ANGLES
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.arange(len(extended.station) + 1))
    middles = []
    full = _FULL_SHARE * np.median(np.diff(bounds)[np.diff(bounds) > 0])
    for k in np.flatnonzero(np.diff(bounds) >= max(full, 1)):
        rows = order[bounds[k] : bounds[k + 1]]
        medians = _medians(bins[rows], radius[rows])
        seen = np.isfinite(medians)
        if seen.mean() < _MIN_SEEN:
            continue
        around = np.interp(centres, centres[seen], medians[seen], period=2 * np.pi)
        line = floor.fit_line(lateral[rows], upward[rows])
        if line is not None:
            bed = floor.radius(line, centres)
            under_track = (np.sin(centres) < _DOWN) & (bed < around + _TRACK)
            around = np.where(under_track, bed, np.minimum(around, bed))
        around = np.minimum(around, _FURTHEST * np.median(around))
        across, along = profile.measure(centres, around).middle
        middles.append(extended.position[k] + across * extended.lateral[k] + along * extended.up[k])
    if len(middles) < 4:
        raise FitError("no tunnel in the cloud: hardly a section shows most of its circumference")
    return np.asarray(middles)


def _medians(bins: np.ndarray, radius: np.ndarray) -> Float[np.ndarray, " m"]:
    order = np.lexsort((radius, bins))
    bounds = np.searchsorted(bins[order], np.arange(_COARSE_ANGLES + 1))
    count = np.diff(bounds)
    if not len(order):
        return np.full(_COARSE_ANGLES, np.nan)
    middle = np.minimum(bounds[:-1] + count // 2, len(order) - 1)
    return np.where(count > 0, radius[order][middle], np.nan)


def _smooth(centres: np.ndarray, cutoff: float) -> Axis:
    """A least-squares cubic spline by chord length with two knots per `cutoff`.

    A smoothing spline would straighten its ends, by 2 cm on an arc of 150 m; this one has no end condition.
    """
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    pieces = min(max(round(2 * chord[-1] / cutoff), 1), len(chord) // 4)
    inner = np.linspace(0.0, chord[-1], max(pieces, 1) + 1)[1:-1]
    knots = np.concatenate([[0.0] * 4, inner, [chord[-1]] * 4])
    if len(chord) <= len(inner) + 4:
        return through(centres, _SPACING)
    return through(make_lsq_spline(chord, centres, knots)(chord), _SPACING)
