"""An as-built survey of rings: a few total-station points on each, one circle a ring, a round bore through them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from scene.bore import POCKET, STATION_STEP, Bore
from scene.errors import FitError, Refusal
from scene.fitting.lining import LiningConfig, add_standard_lining, joints_by_number
from scene.geometry import arc_length, axis_through, section_angles
from scene.reading.ringsurvey import RingSurvey

_MIN_POINTS = 5  # points of a ring
_LARGEST_RESIDUAL = 0.25  # m rms: with more it is no circle
_PASSES = 3  # times that a ring is fitted in the plane square to the axis
_RADII = (0.5, 15.0)  # m
_LEAST_SPACING = 0.05  # m
_LONGEST_GAP = 50.0  # m; across more, nobody knows how the tunnel runs


@dataclass(frozen=True)
class RingFit:
    """The circle of each ring."""

    names: list[str]  # Ring numbers
    centre: Float[np.ndarray, "r 3"]  # m
    radius: Float[np.ndarray, " r"]  # m
    rms: Float[np.ndarray, " r"]  # Distance of the points from the circle, m
    seen: Float[np.ndarray, " r"]  # Fraction of the circumference within 22.5° of a point


def fit_rings(survey: RingSurvey) -> RingFit:
    """Fits a circle to each ring, in the plane square to the axis through the rings' centres.

    Raises `FitError` where a ring has too few points, or they lie on no circle.
    """
    for name, points in zip(survey.names, survey.points, strict=True):
        if len(points) < _MIN_POINTS:
            raise _refuse(survey, f"ring {name} has {len(points)} points; at least {_MIN_POINTS} are needed")
    centre = np.array([points.mean(axis=0) for points in survey.points])
    _require_order(survey, centre)
    for _ in range(_PASSES):
        chord = arc_length(centre)
        tangent = CubicSpline(chord, centre)(chord, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        rows = zip(survey.points, survey.offsets, centre, tangent, strict=True)
        fits = [_fit_circle(*row) for row in rows]
        centre = np.array([fit[0] for fit in fits])
    radius, rms, seen = (np.array([fit[k] for fit in fits]) for k in (1, 2, 3))
    if (rms > _LARGEST_RESIDUAL).any():
        worst = int(np.argmax(rms))
        raise _refuse(survey, f"ring {survey.names[worst]} is no circle (rms {rms[worst]:.2f} m)")
    wrong = (radius < _RADII[0]) | (radius > _RADII[1])
    if wrong.any():
        worst = int(np.argmax(wrong))
        why = f"ring {survey.names[worst]} has a radius of {radius[worst]:.4g} m; is the unit right?"
        raise _refuse(survey, why)
    _require_no_gap(survey, centre)
    return RingFit(survey.names, centre, radius, rms, seen)


def bore_from_rings(fit: RingFit, origin: Float[np.ndarray, "3"]) -> Bore:
    """Return a round bore through the rings less `origin`, m; between rings it is interpolated and marked filled."""
    centre = fit.centre - origin
    axis = axis_through(centre, STATION_STEP)
    at = np.clip(axis.local(centre)[0], 0.0, axis.length)
    angle = section_angles()
    radius = np.interp(axis.station, at, fit.radius)
    distance = np.abs(axis.station[:, None] - at[None]).min(axis=1)
    return Bore(
        axis.station, axis.position, axis.tangent, axis.lateral, axis.up, 2 * radius, 2 * radius, angle,
        np.repeat(radius[:, None], len(angle), axis=1), np.interp(axis.station, at, fit.rms),
        np.interp(axis.station, at, fit.seen), distance > STATION_STEP, at, np.empty(0, POCKET),
    )  # fmt: skip


def _require_order(survey: RingSurvey, centre: np.ndarray) -> None:
    """Refuses rings that do not follow each other along the tunnel."""
    step = np.diff(centre, axis=0)
    length = np.linalg.norm(step, axis=1)
    if (length < _LEAST_SPACING).any():
        at = int(np.argmin(length))
        raise _refuse(survey, f"rings {survey.names[at]} and {survey.names[at + 1]} lie at the same place")
    turn = np.einsum("ij,ij->i", step[:-1], step[1:])
    if (turn < 0).any():
        at = int(np.argmax(turn < 0)) + 1
        raise _refuse(survey, f"the rings are out of order: the tunnel turns back at ring {survey.names[at]}")


def _require_no_gap(survey: RingSurvey, centre: np.ndarray) -> None:
    length = np.linalg.norm(np.diff(centre, axis=0), axis=1)
    if (length > _LONGEST_GAP).any():
        at = int(np.argmax(length))
        raise _refuse(
            survey,
            f"between rings {survey.names[at]} and {survey.names[at + 1]} lie {length[at]:.1f} m without a ring; "
            f"at most {_LONGEST_GAP:g} m can be bridged",
        )


def _refuse(survey: RingSurvey, why: str) -> FitError:
    return FitError(f"{survey.path}: {why}", Refusal.RINGS)


def _fit_circle(
    points: np.ndarray, offset: np.ndarray, centre: np.ndarray, tangent: np.ndarray
) -> tuple[np.ndarray, float, float, float]:
    lateral = np.cross([0.0, 0.0, 1.0], tangent)
    lateral /= np.linalg.norm(lateral)
    up = np.cross(tangent, lateral)
    x, y = (points - centre) @ lateral, (points - centre) @ up

    def misfit(circle: np.ndarray) -> np.ndarray:
        return np.hypot(x - circle[0], y - circle[1]) + offset - circle[2]  # targets stand inside the wall

    start = [0.0, 0.0, float(np.hypot(x, y).mean())]
    a, b, radius = least_squares(misfit, start, loss="soft_l1", f_scale=0.02).x
    angle = np.arctan2(y - b, x - a)
    around = section_angles()
    gap = np.abs(np.angle(np.exp(1j * (around[:, None] - angle[None])))).min(axis=1)
    middle = centre + a * lateral + b * up + ((points - centre) @ tangent).mean() * tangent
    rms = float(np.sqrt(np.mean(misfit(np.array([a, b, radius])) ** 2)))
    return middle, float(radius), rms, float((gap < np.pi / 8).mean())


def fit_ring_survey(
    survey: RingSurvey, lining: LiningConfig
) -> tuple[Bore, Float[np.ndarray, "3"], dict[str, str], dict[str, Any]]:
    """Return the bore of a survey, its origin in the survey's frame, m, and provenance and facts for the manifest."""
    fit = fit_rings(survey)
    origin = np.floor(np.median(fit.centre, axis=0))
    smooth = bore_from_rings(fit, origin)
    joints = joints_by_number(fit.names, smooth.ring_station)
    bore, provenance = add_standard_lining(smooth, lining, False, joints)
    facts = {
        "kind": "ring survey", **survey.facts, "rings": len(fit.names), "first_ring": fit.names[0],
        "last_ring": fit.names[-1], "length_fixed_by": "total-station survey", "radius_mean": float(fit.radius.mean()),
        "radius_sd": float(fit.radius.std()), **bore.describe(),
        "residual_rms": float(np.sqrt(np.mean(fit.rms**2))),
        "largest_target_offset": float(max(offset.max() for offset in survey.offsets)), "flat_floor": False,
    }  # fmt: skip
    return bore, origin, provenance, facts
