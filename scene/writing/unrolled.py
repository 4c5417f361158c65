"""A bore's wall unrolled: its sections, seam and recesses for `subterra_jax.host.unrolled`."""

import numpy as np
from jaxtyping import Float, Int

from scene.bore import Bore
from subterra_jax.host.unrolled import Sections, Unrolled, unroll

SPACING = (0.18, 0.2)  # of the triangulated wall's points, along and around, m
_SIZES = ("station", "angle", "length", "width", "depth")


def sections_of(bore: Bore) -> Sections:
    """Return a bore's smooth wall."""
    return Sections(bore.station, bore.position, bore.tangent, bore.lateral, bore.up, bore.angle, bore.radius)


def wall_points(
    bore: Bore, station: Float[np.ndarray, " k"], angle: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k 3"]:
    """Return points of the smooth wall, bilinear between the sections' points, m."""
    return sections_of(bore).points(station, angle)


def recesses(bore: Bore) -> Float[np.ndarray, "p 5"]:
    """Return station, m, angle, rad, length, width and depth, m, of each pocket."""
    return np.column_stack([bore.pocket[name] for name in _SIZES])


def recess_boxes(bore: Bore, pocket: Int[np.ndarray, " r"]) -> Float[np.ndarray, "r 8 3"]:
    """Return corners of some pockets as boxes square to the wall they are sunk into, m."""
    chosen = recesses(bore)[pocket]
    return sections_of(bore).recess_boxes(chosen, bore.axis.at(chosen[:, 0]).tangent)


def unroll_section(bore: Bore) -> Unrolled:
    """Return the mean section's arc length; the seam is in the widest gap between recesses, else at the floor."""
    taken = np.sort(bore.pocket["angle"] % (2 * np.pi))
    gap = np.diff(np.append(taken, taken[0] + 2 * np.pi)) if len(taken) else np.empty(0)
    seam = taken[np.argmax(gap)] + gap.max() / 2 if len(taken) else 1.5 * np.pi
    return unroll(bore.angle, bore.radius.mean(axis=0), seam)
