"""Gauge measured on meshes: rays from between the rails, 14 mm below their tops, to the inner faces of the heads."""

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.surface import Caster

BELOW_TOP = 0.014  # m; EN 13848 measures there
_STEP = 0.5  # m


def gauges(
    curve: Curve, mesh: trimesh.Trimesh, left: Float[np.ndarray, "k 3"], right: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, " n"]:
    """Distance between the inner faces, every half metre, m.

    Args:
        curve: Along which the rails lie.
        mesh: Of the rails.
        left: Points of the left rail at the height of its top, in any order.
        right: Of the right one.

    Raises:
        ValueError: There are no two rails.
    """
    if min(len(left), len(right)) < 2 or not len(mesh.faces):
        raise ValueError("there are no two rails")
    tops = [_sorted(curve, rail) for rail in (left, right)]
    start, end = max(top[0, 0] for top in tops), min(top[-1, 0] for top in tops)
    station = np.arange(start + 0.13, end - 0.1, _STEP)
    ends = [
        curve.point(np.column_stack([station, *(np.interp(station, top[:, 0], top[:, k]) for k in (1, 2))]))
        for top in tops
    ]
    across = ends[0] - ends[1]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(curve.frames(station)[1], across)
    middle = (ends[0] + ends[1]) / 2 - BELOW_TOP * up
    caster = Caster(mesh)
    reach = caster.first(middle, across)[0] + caster.first(middle, -across)[0]
    reach = reach[np.isfinite(reach)]
    if not len(reach):
        raise ValueError("no ray between the rails meets both")
    return reach


def _sorted(curve: Curve, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Station, left and up of points, in order of station."""
    local = curve.local(points)
    return local[np.argsort(local[:, 0], kind="stable")]
