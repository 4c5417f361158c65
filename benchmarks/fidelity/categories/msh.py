"""MSH: whether the meshes are what a mesh of a bore must be."""

import mujoco
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from manifold3d import Error, Manifold, Mesh64
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import shell
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, number, passed

_THIN = 1e-6  # m; a triangle no higher than this has no normal
_POSES = 3
_GRAZING = 0.1  # cosine; flatter hits would each stand for square metres


@metric("mesh_finite")
def mesh_finite(case: Case) -> Value:
    """Vertices finite, faces in range, of lining, solid and extra."""
    judged = case.candidate
    return passed(all(shell.sound(mesh) for mesh in (judged.lining, judged.solid, judged.extra)))


@metric("mesh_watertight")
def mesh_watertight(case: Case) -> Value:
    """Every edge of the solid has two faces."""
    return passed(shell.solid(case).is_watertight)


@metric("mesh_winding_consistent")
def mesh_winding_consistent(case: Case) -> Value:
    """Neighbouring faces run along their edge in opposite senses, in lining and solid."""
    return passed(shell.lining(case).is_winding_consistent and shell.solid(case).is_winding_consistent)


@metric("mesh_orientation_frac")
def mesh_orientation_frac(case: Case) -> Value:
    """Share of the lining's area whose normal looks at the axis, each ray standing for the area that it sees."""
    hits = shell.axis_hits(case)
    met = np.isfinite(hits.distance)
    area = hits.distance[met] ** 2 / np.maximum(np.abs(hits.cosine[met]), _GRAZING)
    return number(np.sum(area * (hits.cosine[met] < 0)) / np.sum(area), int(met.sum()))


@metric("mesh_is_volume")
def mesh_is_volume(case: Case) -> Value:
    """By trimesh, and by MuJoCo's exact inertia, which refuses what is wound inside out."""
    solid = shell.solid(case)
    if not solid.is_volume:
        return passed(False, "trimesh: watertight, wound, finite and positive are not all true")
    try:
        _exact(solid)
    except ValueError as error:
        return passed(False, f"MuJoCo: {error}"[:200])
    return passed(True)


def _exact(solid: trimesh.Trimesh) -> None:
    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="solid", uservert=solid.vertices.ravel(), userface=solid.faces.ravel().astype(np.int32),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT,
    )  # fmt: skip
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="solid", contype=0, conaffinity=0)
    spec.compile()


@metric("mesh_manifold_status")
def mesh_manifold_status(case: Case) -> Value:
    """manifold3d takes the solid as it is."""
    mesh = shell.solid(case)
    solid = Manifold(Mesh64(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.uint64)))
    return passed(solid.status() == Error.NoError and not solid.is_empty(), solid.status().name)


@metric("mesh_boundary_unexpected")
def mesh_boundary_unexpected(case: Case) -> Value:
    """Length of the lining's rims outside the two mouths, of the length of all edges."""
    edges, mouth = shell.lining_edges(case), shell.at_mouth(case)
    rim = (edges.faces == 1) & ~mouth[edges.ends].all(axis=1)
    return number(edges.length[rim].sum() / edges.length.sum(), len(edges.length))


@metric("mesh_nonmanifold_edges")
def mesh_nonmanifold_edges(case: Case) -> Value:
    """Share of edges with more than two faces; the worse of lining and solid."""
    both = shell.lining_edges(case), shell.solid_edges(case)
    return number(max(float(np.mean(edges.faces > 2)) for edges in both), sum(len(edges.faces) for edges in both))


@metric("mesh_duplicate_faces")
def mesh_duplicate_faces(case: Case) -> Value:
    """Share of faces that another face repeats, whichever way round; the worse of lining and solid."""
    both = shell.lining(case), shell.solid(case)
    shares = [1.0 - len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) / len(mesh.faces) for mesh in both]
    return number(max(shares), sum(len(mesh.faces) for mesh in both))


@metric("mesh_degenerate_faces")
def mesh_degenerate_faces(case: Case) -> Value:
    """Share of faces lower than a thousandth of a millimetre; the worse of lining and solid."""
    both = shell.lining(case), shell.solid(case)
    return number(max(float(np.mean(_heights(mesh) < _THIN)) for mesh in both), sum(len(mesh.faces) for mesh in both))


def _heights(mesh: trimesh.Trimesh) -> np.ndarray:
    longest = np.linalg.norm(np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1), axis=2).max(axis=1)
    return 2.0 * mesh.area_faces / np.maximum(longest, 1e-12)


@metric("mesh_self_intersections")
def mesh_self_intersections(case: Case) -> Value:
    """Share of the lining's faces that cut another one, however the mesh is turned.

    Faces that lie in one plane and share a corner may seem to cut each other by rounding, in one pose but not in all.
    """
    mesh = shell.lining(case)
    cut = np.ones(len(mesh.faces), bool)
    for turn in Rotation.random(_POSES, rng=case.rng("mesh_self_intersections")):
        if cut.any():
            cut &= _cut(turn.apply(mesh.vertices), mesh.faces)
    return number(float(np.mean(cut)), len(cut))


def _cut(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    import pymeshlab

    judged = pymeshlab.MeshSet()
    judged.add_mesh(pymeshlab.Mesh(vertices, faces.astype(np.int32)))
    judged.compute_selection_by_self_intersections_per_face()
    return np.asarray(judged.current_mesh().face_selection_array(), bool)


@metric("mesh_volume_vs_sections")
def mesh_volume_vs_sections(case: Case) -> Value:
    """Volume of the solid against the sections of `bore.npz` with the pockets that it lists, %."""
    bore, solid = case.candidate.bore, shell.solid(case)
    x, y = bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    area = 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)
    pocket = bore.pocket
    sections = np.trapezoid(area, bore.station) + float(np.sum(pocket["length"] * pocket["width"] * pocket["depth"]))
    return number(100.0 * abs(solid.volume - sections) / abs(solid.volume), len(area))
