"""MSH, TRI and TOP: validity, triangles and topology of the meshes."""

import mujoco
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from manifold3d import Error, Manifold, Mesh64
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import mesh as derived
from benchmarks.fidelity.derive.clouds import hold_patches, lining_roughness
from benchmarks.fidelity.derive.curve import candidate_curve
from benchmarks.fidelity.meshes import connected_groups
from benchmarks.fidelity.registry import Value, missing, number, pass_or_fail
from benchmarks.fidelity.table import B, D, P, U, metric

_THIN = 1e-6  # m; a triangle no higher than this has no normal
_TURNS = 3
_GRAZING = 0.1  # cosine; flatter hits would each stand for square metres
_ABOVE_FLOOR = 0.10  # m; higher vertices belong to the wall
_EDGE_ZONE = 0.05  # m about a pocket or along a corner of the section, in which normals turn by design
_FLAT = 1e6  # aspect of a triangle without height
_LASTING_PERSISTENCE = 0.3  # m of persistence, from which a loop or a void counts


# MSH: the meshes of a bore are sound, closed and wound alike.


@metric("mesh_finite", "MSH", P, "bool", gate=True)
def mesh_finite(case: Case) -> Value:
    """Vertices finite and faces in range, of lining, solid and extra surfaces."""
    judged = case.candidate
    return pass_or_fail(all(derived.is_sound(mesh) for mesh in (judged.lining, judged.solid, judged.extra)))


@metric("mesh_watertight", "MSH", P, "bool", gate=True)
def mesh_watertight(case: Case) -> Value:
    """Every edge of the solid has two faces."""
    return pass_or_fail(derived.welded_solid(case).is_watertight)


@metric("mesh_winding_consistent", "MSH", P, "bool", gate=True)
def mesh_winding_consistent(case: Case) -> Value:
    """Neighbouring faces run along their edge in opposite senses, in lining and solid."""
    both = derived.welded_lining(case), derived.welded_solid(case)
    return pass_or_fail(all(mesh.is_winding_consistent for mesh in both))


@metric("mesh_orientation_frac", "MSH", U(0.98, 0.999), gate=True)
def mesh_orientation_frac(case: Case) -> Value:
    """Fraction of the lining's area whose normal looks at the axis; each ray stands for the area that it sees."""
    hits = derived.axis_hits(case)
    met = np.isfinite(hits.distance)
    area = hits.distance[met] ** 2 / np.maximum(np.abs(hits.cosine[met]), _GRAZING)
    return number(np.sum(area * (hits.cosine[met] < 0)) / np.sum(area), int(met.sum()))


@metric("mesh_is_volume", "MSH", P, "bool")
def mesh_is_volume(case: Case) -> Value:
    """The solid is a volume for trimesh and for MuJoCo's exact inertia, which refuses an inverted one."""
    solid = derived.welded_solid(case)
    if not solid.is_volume:
        return pass_or_fail(False, "trimesh: watertight, wound, finite and positive are not all true")
    try:
        _compile_exact(solid)
    except ValueError as error:
        return pass_or_fail(False, f"MuJoCo: {error}"[:200])
    return pass_or_fail(True)


def _compile_exact(solid: trimesh.Trimesh) -> None:
    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="solid", uservert=solid.vertices.ravel(), userface=solid.faces.ravel().astype(np.int32),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT,
    )  # fmt: skip
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="solid", contype=0, conaffinity=0)
    spec.compile()


@metric("mesh_manifold_status", "MSH", P, "bool")
def mesh_manifold_status(case: Case) -> Value:
    """manifold3d accepts the solid as it is."""
    solid = _manifold(derived.welded_solid(case))
    return pass_or_fail(solid.status() == Error.NoError and not solid.is_empty(), solid.status().name)


def _manifold(mesh: trimesh.Trimesh) -> Manifold:
    return Manifold(Mesh64(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.uint64)))


@metric("mesh_boundary_unexpected", "MSH", D(0, 0.002))
def mesh_boundary_unexpected(case: Case) -> Value:
    """Length of the lining's rims outside the two mouths over the length of all edges."""
    edges, mouth = derived.lining_edges(case), derived.mouth_vertices(case)
    rim = (edges.faces == 1) & ~mouth[edges.ends].all(axis=1)
    return number(edges.length[rim].sum() / edges.length.sum(), len(edges.length))


@metric("mesh_nonmanifold_edges", "MSH", D(0, 0.001))
def mesh_nonmanifold_edges(case: Case) -> Value:
    """Fraction of edges with more than two faces; the worse of lining and solid."""
    both = derived.lining_edges(case), derived.mesh_edges(derived.welded_solid(case))
    return number(max(float(np.mean(edges.faces > 2)) for edges in both), sum(len(edges.faces) for edges in both))


@metric("mesh_duplicate_faces", "MSH", D(0, 0.001))
def mesh_duplicate_faces(case: Case) -> Value:
    """Fraction of faces that another face repeats, whichever way round; the worse of lining and solid."""
    both = derived.welded_lining(case), derived.welded_solid(case)
    fractions = [1.0 - len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) / len(mesh.faces) for mesh in both]
    return number(max(fractions), sum(len(mesh.faces) for mesh in both))


@metric("mesh_degenerate_faces", "MSH", D(0, 0.001))
def mesh_degenerate_faces(case: Case) -> Value:
    """Fraction of faces lower than a thousandth of a millimetre; the worse of lining and solid."""
    both = derived.welded_lining(case), derived.welded_solid(case)
    thin = [2.0 * mesh.area_faces / np.maximum(_side_lengths(mesh).max(axis=1), 1e-12) < _THIN for mesh in both]
    return number(max(float(np.mean(one)) for one in thin), sum(len(mesh.faces) for mesh in both))


def _side_lengths(mesh: trimesh.Trimesh) -> Float[np.ndarray, "f 3"]:
    return np.linalg.norm(np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1), axis=2)


@metric("mesh_self_intersections", "MSH", D(0, 0.005))
def mesh_self_intersections(case: Case) -> Value:
    """Fraction of the lining's faces that cut another one in every pose of the mesh.

    Faces that lie in one plane and share a corner may seem to cut each other by rounding, in one pose but not in all.
    """
    mesh = derived.welded_lining(case)
    cut = np.ones(len(mesh.faces), bool)
    for turn in Rotation.random(_TURNS, rng=case.rng("mesh_self_intersections")):
        if cut.any():
            cut &= _cut_faces(turn.apply(mesh.vertices), mesh.faces)
    return number(float(np.mean(cut)), len(cut))


def _cut_faces(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    import pymeshlab

    judged = pymeshlab.MeshSet()
    judged.add_mesh(pymeshlab.Mesh(vertices, faces.astype(np.int32)))
    judged.compute_selection_by_self_intersections_per_face()
    return np.asarray(judged.current_mesh().face_selection_array(), bool)


@metric("mesh_volume_vs_sections", "MSH", D(0.5, 5), "%")
def mesh_volume_vs_sections(case: Case) -> Value:
    """Volume of the solid against the sections of `bore.npz` with the pockets that it lists, %."""
    bore, solid = case.candidate.bore, derived.welded_solid(case)
    x, y = bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    area = 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)
    pocket = bore.pocket
    sections = np.trapezoid(area, bore.station) + float(np.sum(pocket["length"] * pocket["width"] * pocket["depth"]))
    return number(100.0 * abs(solid.volume - sections) / abs(solid.volume), len(area))


# TRI: the triangles are well shaped and small enough for what they show.


@metric("tri_aspect_p95", "TRI", D(8, 60))
def tri_aspect_p95(case: Case) -> Value:
    """95th percentile of the longest edge over the shortest height."""
    mesh = derived.welded_lining(case)
    longest = _side_lengths(mesh).max(axis=1)
    aspect = np.minimum(longest**2 / np.maximum(2.0 * mesh.area_faces, 1e-12), _FLAT)
    return number(np.percentile(aspect, 95), len(aspect))


@metric("tri_min_angle_p05", "TRI", U(1, 10), "deg")
def tri_min_angle_p05(case: Case) -> Value:
    """5th percentile of the smallest angle, degrees."""
    angle = _least_angles(derived.welded_lining(case))
    return number(np.percentile(angle, 5), len(angle))


@metric("tri_sliver_frac", "TRI", D(0.001, 0.015))
def tri_sliver_frac(case: Case) -> Value:
    """Fraction of triangles with an angle below 1 degree."""
    angle = _least_angles(derived.welded_lining(case))
    return number(float(np.mean(angle < 1.0)), len(angle))


def _least_angles(mesh: trimesh.Trimesh) -> Float[np.ndarray, " f"]:
    return np.degrees(np.nan_to_num(mesh.face_angles, nan=0.0).min(axis=1))


@metric("tri_edge_p95", "TRI", D(0.25, 1.5), "m")
def tri_edge_p95(case: Case) -> Value:
    """95th percentile of the edge length on the wall, m."""
    edges, wall = derived.lining_edges(case), _on_wall(case)
    length = edges.length[wall[edges.ends].all(axis=1)]
    return number(np.percentile(length, 95), len(length))


@metric("tri_chord_error_max", "TRI", D(0.005, 0.05), "m")
def tri_chord_error_max(case: Case) -> Value:
    """Largest bulge of the axis from its chord over the stretch that an edge spans, m."""
    curve, edges = candidate_curve(case), derived.lining_edges(case)
    station = curve.local(derived.welded_lining(case).vertices + derived.weld_offset(case))[:, 0]
    start, end = np.clip(station[edges.ends], curve.station[0], curve.station[-1]).T
    here, there, between = (curve.frames(s)[0] for s in (start, end, (start + end) / 2))
    return number(np.linalg.norm(between - (here + there) / 2, axis=1).max(), len(start))


@metric("tri_normal_noise", "TRI", D(3, 25), "deg")
def tri_normal_noise(case: Case) -> Value:
    """Median angle between neighbours on the wall away from pockets and corners, degrees."""
    mesh = derived.welded_lining(case)
    clear = (_on_wall(case) & ~_near_pockets(case))[mesh.face_adjacency_edges].all(axis=1)
    angle = np.degrees(mesh.face_adjacency_angles[clear])
    return number(np.median(angle), len(angle))


def _on_wall(case: Case) -> Bool[np.ndarray, " v"]:
    """Mark the vertices of the welded lining above the foot of the walls."""
    bore = case.candidate.bore
    station, _, up = candidate_curve(case).local(derived.welded_lining(case).vertices + derived.weld_offset(case)).T
    floor = -np.max(-bore.radius * np.sin(bore.angle), axis=1)
    return up > np.interp(station, bore.station, floor) + _ABOVE_FLOOR


def _near_pockets(case: Case) -> Bool[np.ndarray, " v"]:
    """Mark the vertices of the welded lining in or beside a pocket that `bore.npz` lists."""
    pocket = case.candidate.bore.pocket
    station, left, up = candidate_curve(case).local(derived.welded_lining(case).vertices + derived.weld_offset(case)).T
    near = np.zeros(len(station), bool)
    order = np.argsort(station)
    for one in pocket:
        half = one["length"] / 2 + _EDGE_ZONE
        rows = order[slice(*np.searchsorted(station, [one["station"] - half, one["station"] + half], sorter=order))]
        across = np.hypot(left[rows], up[rows])
        turn = (np.arctan2(up[rows], left[rows]) - one["angle"] + np.pi) % (2.0 * np.pi) - np.pi
        near[rows[np.abs(turn) * across < one["width"] / 2 + _EDGE_ZONE]] = True
    return near


@metric("tri_roughness_ratio", "TRI", B(1, 0.947, 2.8), needs="hold")
def tri_roughness_ratio(case: Case) -> Value:
    """Residual from planes of 0.5 m: the lining where held-out beams meet it, over those beams' less their noise.

    Where the wall is so smooth that its roughness drowns in the noise, the noise stays in both.
    """
    real, roughness = hold_patches(case), lining_roughness(case)
    if real is None:
        return missing("too few held-out points on smooth wall for planes of 0.5 m")
    if real.resolved:
        return number(np.sqrt(roughness / real.roughness), real.planes)
    reason = f"the wall's own roughness drowns in {1e3 * np.sqrt(real.noise):.0f} mm of noise, which stays in both"
    whole = max(real.roughness + real.noise, 1e-12)
    return number(np.sqrt((roughness + real.noise) / whole), real.planes, reason)


@metric("tri_face_count", "TRI", unit="count")
def tri_face_count(case: Case) -> Value:
    """Number of faces of the lining."""
    return number(len(case.candidate.lining.faces), 1)


# TOP: the bore is one tube with two mouths, whole and empty.


@metric("topo_body_count_err", "TOP", D(0, 3), "count")
def topo_body_count_err(case: Case) -> Value:
    """Components of lining and extra surfaces beyond the one expected."""
    extra = case.candidate.extra
    loose = int(derived.face_parts(derived.weld(extra)).max()) + 1 if len(extra.faces) else 0
    return number(abs(int(derived.face_parts(derived.welded_lining(case)).max()) + 1 + loose - 1), 1)


@metric("topo_chi_err", "TOP", D(0, 6), "count")
def topo_chi_err(case: Case) -> Value:
    """Difference of the solid's Euler characteristic from the 2 of a ball."""
    return number(abs(derived.welded_solid(case).euler_number - 2), 1)


@metric("topo_genus", "TOP", D(0, 3), "count")
def topo_genus(case: Case) -> Value:
    """Handles of the solid."""
    solid = _manifold(derived.welded_solid(case))
    if solid.status() != Error.NoError or solid.is_empty():
        raise ValueError(f"the solid is none: {solid.status().name}")
    return number(abs(solid.genus()), 1)


@metric("topo_mouth_err", "TOP", D(0, 1), "count", gate=True)
def topo_mouth_err(case: Case) -> Value:
    """Difference of the number of rims of the open lining from the two expected."""
    edges = derived.lining_edges(case)
    rim = edges.ends[edges.faces == 1]
    if not len(rim):
        return number(2.0, 0)
    vertex, ends = np.unique(rim, return_inverse=True)
    rims = int(connected_groups(len(vertex), ends.reshape(-1, 2)).max()) + 1
    return number(abs(rims - 2), len(rim))


@metric("topo_free_b0", "TOP", B(1, 0, 1), "count", gate=True)
def topo_free_b0(case: Case) -> Value:
    """Pieces of free space that the centreline runs through; one is right."""
    count, cells = derived.free_components(case)
    return number(count, cells)


@metric("topo_leak_frac", "TOP", D(0.0001, 0.01), gate=True)
def topo_leak_frac(case: Case) -> Value:
    """Fraction of rays from the axis that meet no lining and leave by neither mouth."""
    hits = derived.axis_hits(case)
    missed = np.flatnonzero(~np.isfinite(hits.distance))
    leaves = np.zeros(len(missed), bool)
    for end in (0, -1):
        leaves |= _through_mouth(case, hits.origin[missed], hits.direction[missed], end)
    return number(np.sum(~leaves) / len(hits.distance), len(hits.distance))


def _through_mouth(case: Case, origin: np.ndarray, direction: np.ndarray, end: int) -> np.ndarray:
    """Mark the rays that cross the plane of a mouth inside its outline; 2 cm of rim are allowed for."""
    bore = case.candidate.bore
    middle, tangent = bore.position[end] - derived.weld_offset(case), bore.tangent[end]
    outward = direction @ tangent * (-1.0 if end == 0 else 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = ((middle - origin) @ tangent) / (direction @ tangent)
    at = origin + np.where(np.isfinite(reach), reach, 0.0)[:, None] * direction - middle
    across, above = at @ bore.lateral[end], at @ bore.up[end]
    wall = np.interp(np.arctan2(above, across), bore.angle, bore.radius[end], period=2.0 * np.pi)
    deepest = float(np.max(case.candidate.bore.pocket["depth"], initial=0.0))
    return (outward > 0) & (np.hypot(across, above) < wall + deepest + 0.02)


@metric("topo_free_b1_err", "TOP", D(1e-06, 4), "count", needs="reference", args=(1,))
@metric("topo_free_b2_err", "TOP", D(1e-06, 4), "count", needs="reference", args=(2,))
def lasting_difference(case: Case, dimension: int) -> Value:
    """Difference in the number of lasting loops (1) or of bodies that float in the free space (2)."""
    diagrams = derived.candidate_diagrams(case)[dimension], derived.reference_diagrams(case)[dimension]
    judged, real = (int(np.sum(d[:, 1] - d[:, 0] > _LASTING_PERSISTENCE)) for d in diagrams)
    return number(abs(judged - real), judged + real)


@metric("topo_bottleneck_h0", "TOP", D(1e-06, 0.8), "m", needs="reference", args=(0,))
@metric("topo_bottleneck_h1", "TOP", unit="m", needs="reference", args=(1,))
def bottleneck_distance(case: Case, dimension: int) -> Value:
    """Bottleneck distance of the clearance diagrams of components (0) or loops (1), m."""
    import gudhi

    judged, real = derived.candidate_diagrams(case)[dimension], derived.reference_diagrams(case)[dimension]
    return number(gudhi.bottleneck_distance(judged, real), len(judged) + len(real))


@metric("topo_floater_area", "TOP", D(0, 0.01))
def topo_floater_area(case: Case) -> Value:
    """Fraction of the area of lining and extra surfaces that is not in the lining's largest piece."""
    mesh, extra = derived.welded_lining(case), case.candidate.extra
    area = np.bincount(derived.face_parts(mesh), weights=mesh.area_faces)
    whole = area.sum() + (extra.area if len(extra.faces) else 0.0)
    return number(1.0 - area.max() / whole, len(mesh.faces) + len(extra.faces))
