"""From the way that cleaning followed to the axis: through mid-width and mid-height, smooth, with arc length.

The way is pulled to the middle of the sections a few times.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline

from scene import geometry
from scene.errors import FitError, Refusal
from scene.fitting.floor import fit_floor_line, floor_radius
from scene.geometry import Axis, measure_section

_OVERRUN = 6.0  # m beyond the axis that are looked at
_THIN_FRACTION, _THIN = 0.05, 20  # of the usual number of points, and points: a section that is hardly seen has fewer
_UNUSUAL, _ROUGH = 0.3, 6.0  # m from the usual section, and standard deviations of the wall about it
_SPACING = 1.0  # m between sections
_PASSES = 4  # times that the axis is pulled to the middle
_COARSE_ANGLES = 72  # directions of a section
_POINTS_PER_METRE = 5_000  # more say no more of a middle
_MIN_SEEN = 0.6  # fraction of the directions of a section that counts
_FURTHEST = 2.0  # times the median radius of a section: further is a passage, which has no part in its middle
_DOWN, _TRACK = -0.8, 0.5  # directions in which sleepers and rails may hide the bed, and how deep, m


@dataclass(frozen=True)
class CentrelineConfig:
    """Settings of the search for the axis."""

    min_length: float = 10.0  # A cloud shorter than this is refused, m.
    cutoff: float = 12.0  # Wavelength that smoothing halves, m; shorter waviness is the wall's, not the axis'.


def centre_axis(
    points: Float[np.ndarray, "n 3"],
    axis: Axis,
    config: CentrelineConfig,
    usual: Callable[[Axis], Float[np.ndarray, "k rays"]],
) -> Axis:
    """Pulls an axis to the middle of the sections a few times; see `section_middles`.

    Raises `FitError` where it ends up too short.
    """
    stride = max(1, int(len(points) / (axis.length * _POINTS_PER_METRE)))
    sample = points[::stride].astype(np.float64)
    for _ in range(_PASSES):
        axis = smooth_axis(section_middles(sample, axis, usual), config.cutoff)
    if axis.length < config.min_length:
        why = f"the tunnel is {axis.length:.1f} m long; at least {config.min_length:g} m are needed"
        raise FitError(why, Refusal.SHORT)
    return axis


def section_middles(
    points: np.ndarray, axis: Axis, usual: Callable[[Axis], Float[np.ndarray, "k rays"]]
) -> Float[np.ndarray, "k 3"]:
    """Return the middle of each section seen well enough, one a metre.

    `usual` returns the usual radii at stations of an axis. They stand in for directions in which nothing was seen, or
    something 30 cm off (on rough walls further): a niche, a lay-by, a flare.
    """
    extended = axis.at(np.arange(-_OVERRUN, axis.length + _OVERRUN, _SPACING))
    station, lateral, upward = extended.local(points)
    index = np.rint((station - extended.station[0]) / _SPACING).astype(np.intp)
    angle, radius = np.arctan2(upward, lateral), np.hypot(lateral, upward)
    bins = geometry.angle_bins(angle, _COARSE_ANGLES)
    centres = geometry.section_angles(_COARSE_ANGLES) + np.pi / _COARSE_ANGLES
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.arange(len(extended.station) + 1))
    count = np.diff(bounds)
    # Far from the last tripod a bore is thin, but goes on.
    enough = np.flatnonzero(count >= max(_THIN_FRACTION * float(np.median(count[count > 0])), _THIN))
    if not len(enough):
        why = "no tunnel in the cloud: none of its returns lies on the wall of the way that was followed"
        raise FitError(why, Refusal.NO_BORE)
    sections = [order[bounds[k] : bounds[k + 1]] for k in range(enough[0], enough[-1] + 1)]
    seen_wall = np.array([geometry.bin_medians(bins[rows], radius[rows], _COARSE_ANGLES) for rows in sections])
    stand_in = usual(extended)[enough[0] : enough[-1] + 1]
    off = np.abs(seen_wall - stand_in)
    # Where rough walls depart as far, what departs is wall: a stand-in for every bump would move the axis.
    limit = max(_UNUSUAL, _ROUGH * 1.4826 * float(np.nanmedian(off)))
    middles, shown = [], []
    for k, rows in enumerate(sections, enough[0]):
        usual_here = off[k - enough[0]] < limit
        around = np.where(usual_here, seen_wall[k - enough[0]], stand_in[k - enough[0]])
        if np.isfinite(around).mean() < _MIN_SEEN:
            continue
        shown.append(float(usual_here.mean()))
        seen = np.isfinite(around)
        around = np.interp(centres, centres[seen], around[seen], period=2 * np.pi)
        line = fit_floor_line(lateral[rows], upward[rows])
        if line is not None:
            bed = floor_radius(line, centres)
            under_track = (np.sin(centres) < _DOWN) & (bed < around + _TRACK)
            around = np.where(under_track, bed, np.minimum(around, bed))
        around = np.minimum(around, _FURTHEST * np.median(around))
        across, along = measure_section(centres, around).middle
        middles.append(extended.position[k] + across * extended.lateral[k] + along * extended.up[k])
    if len(middles) < 4:
        raise FitError("no tunnel in the cloud: hardly a section shows most of its circumference", Refusal.UNSEEN)
    return np.asarray(middles)[_cut_begun(np.array(shown))]


_BEGUN = 0.8  # of the directions that the next sections show
_NEXT = 3  # sections


def _cut_begun(shown: Float[np.ndarray, " k"]) -> slice:
    """Return the sections without one at either end that is only begun: its middle would bend the axis.

    A mouth cuts it off aslant, and of what lies before a mouth there is no crown. `shown` is the fraction of each
    section's directions that show its wall.
    """
    if len(shown) < 4 * _NEXT:
        return slice(None)
    first, last = (int(ends[0] < _BEGUN * np.median(ends[1 : _NEXT + 1])) for ends in (shown, shown[::-1]))
    return slice(first, len(shown) - last)


def smooth_axis(centres: np.ndarray, cutoff: float) -> Axis:
    """Return a least-squares cubic spline by chord length with two knots per `cutoff`.

    A smoothing spline would straighten its ends, by 2 cm on an arc of 150 m; this one has no end condition.
    """
    chord = geometry.arc_length(centres)
    pieces = min(max(round(2 * chord[-1] / cutoff), 1), len(chord) // 4)
    inner = np.linspace(0.0, chord[-1], max(pieces, 1) + 1)[1:-1]
    knots = np.concatenate([[0.0] * 4, inner, [chord[-1]] * 4])
    if len(chord) <= len(inner) + 4:
        return geometry.axis_through(centres, _SPACING)
    return geometry.axis_through(make_lsq_spline(chord, centres, knots)(chord), _SPACING)
