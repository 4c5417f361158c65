"""TRI: whether the lining's triangles are well shaped and small enough for what they show."""

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import roughness, shell
from benchmarks.fidelity.derive.curve import candidate_curve
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, missing, number

_ABOVE_FLOOR = 0.10  # m; what lies higher is wall
_EDGE_ZONE = 0.05  # m about a pocket or along a corner of the section, in which normals turn by design
_FLAT = 1e6  # aspect of a triangle without height


@metric("tri_aspect_p95")
def tri_aspect_p95(case: Case) -> Value:
    """Longest edge over shortest height."""
    mesh = shell.lining(case)
    longest = _sides(mesh).max(axis=1)
    aspect = np.minimum(longest**2 / np.maximum(2.0 * mesh.area_faces, 1e-12), _FLAT)
    return number(np.percentile(aspect, 95), len(aspect))


@metric("tri_min_angle_p05")
def tri_min_angle_p05(case: Case) -> Value:
    """Smallest angle, deg."""
    angle = _least_angles(shell.lining(case))
    return number(np.percentile(angle, 5), len(angle))


@metric("tri_sliver_frac")
def tri_sliver_frac(case: Case) -> Value:
    """Share of triangles with an angle below 1 deg."""
    angle = _least_angles(shell.lining(case))
    return number(float(np.mean(angle < 1.0)), len(angle))


@metric("tri_edge_p95")
def tri_edge_p95(case: Case) -> Value:
    """Edge length on the wall, m."""
    edges, wall = shell.lining_edges(case), _on_wall(case)
    length = edges.length[wall[edges.ends].all(axis=1)]
    return number(np.percentile(length, 95), len(length))


@metric("tri_chord_error_max")
def tri_chord_error_max(case: Case) -> Value:
    """How far the axis bulges from its chord over the stretch that the longest edge spans, m."""
    curve, edges = candidate_curve(case), shell.lining_edges(case)
    station = curve.local(shell.lining(case).vertices + shell.offset(case))[:, 0]
    start, end = np.clip(station[edges.ends], curve.station[0], curve.station[-1]).T
    here, there, between = (curve.frames(s)[0] for s in (start, end, (start + end) / 2))
    return number(np.linalg.norm(between - (here + there) / 2, axis=1).max(), len(start))


@metric("tri_normal_noise")
def tri_normal_noise(case: Case) -> Value:
    """Median angle between neighbours on the wall away from pockets and corners, deg."""
    mesh = shell.lining(case)
    clear = (_on_wall(case) & ~_near_pockets(case))[mesh.face_adjacency_edges].all(axis=1)
    angle = np.degrees(mesh.face_adjacency_angles[clear])
    return number(np.median(angle), len(angle))


@metric("tri_roughness_ratio", needs="hold")
def tri_roughness_ratio(case: Case) -> Value:
    """Residual from planes of 0.5 m: the lining where held-out beams meet it, over those beams' less their noise.

    Where the wall is so smooth that its roughness drowns in the noise, the noise stays in both.
    """
    real, made = roughness.of_reference(case), roughness.of_lining(case)
    if real is None:
        return missing("too few held-out points on smooth wall for planes of 0.5 m")
    if real.resolved:
        return number(np.sqrt(made / real.roughness), real.planes)
    reason = f"the wall's own roughness drowns in {1e3 * np.sqrt(real.noise):.0f} mm of noise, which stays in both"
    whole = max(real.roughness + real.noise, 1e-12)
    return number(np.sqrt((made + real.noise) / whole), real.planes, reason)


@metric("tri_face_count")
def tri_face_count(case: Case) -> Value:
    """Of the lining."""
    return number(len(case.candidate.lining.faces), 1)


def _sides(mesh: trimesh.Trimesh) -> Float[np.ndarray, "f 3"]:
    return np.linalg.norm(np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1), axis=2)


def _least_angles(mesh: trimesh.Trimesh) -> Float[np.ndarray, " f"]:
    return np.degrees(np.nan_to_num(mesh.face_angles, nan=0.0).min(axis=1))


def _on_wall(case: Case) -> Bool[np.ndarray, " v"]:
    """Vertices of the welded lining above the foot of the walls."""
    bore = case.candidate.bore
    station, _, up = candidate_curve(case).local(shell.lining(case).vertices + shell.offset(case)).T
    floor = -np.max(-bore.radius * np.sin(bore.angle), axis=1)
    return up > np.interp(station, bore.station, floor) + _ABOVE_FLOOR


def _near_pockets(case: Case) -> Bool[np.ndarray, " v"]:
    """Vertices of the welded lining in or beside a pocket that `bore.npz` lists."""
    pocket = case.candidate.bore.pocket
    station, left, up = candidate_curve(case).local(shell.lining(case).vertices + shell.offset(case)).T
    near = np.zeros(len(station), bool)
    order = np.argsort(station)
    for one in pocket:
        half = one["length"] / 2 + _EDGE_ZONE
        rows = order[slice(*np.searchsorted(station, [one["station"] - half, one["station"] + half], sorter=order))]
        across = np.hypot(left[rows], up[rows])
        turn = (np.arctan2(up[rows], left[rows]) - one["angle"] + np.pi) % (2.0 * np.pi) - np.pi
        near[rows[np.abs(turn) * across < one["width"] / 2 + _EDGE_ZONE]] = True
    return near
