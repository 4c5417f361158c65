"""TOP: whether the bore is one tube with two mouths, whole and empty, as the real one is."""

import numpy as np
from manifold3d import Error, Manifold, Mesh64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import freespace, shell
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, number

_LASTING = 0.3  # m of persistence, from which a loop or a void counts


@metric("topo_body_count_err")
def topo_body_count_err(case: Case) -> Value:
    """Components of lining and extra surfaces; one is expected."""
    return number(abs(_bodies(case) - 1), 1)


def _bodies(case: Case) -> int:
    extra = case.candidate.extra
    loose = int(shell.parts(shell.welded(extra)).max()) + 1 if len(extra.faces) else 0
    return int(shell.parts(shell.lining(case)).max()) + 1 + loose


@metric("topo_chi_err")
def topo_chi_err(case: Case) -> Value:
    """Euler characteristic of the solid against a ball's 2."""
    return number(abs(shell.solid(case).euler_number - 2), 1)


@metric("topo_genus")
def topo_genus(case: Case) -> Value:
    """Handles of the solid.

    Raises:
        ValueError: manifold3d does not take it for a solid.
    """
    mesh = shell.solid(case)
    solid = Manifold(Mesh64(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.uint64)))
    if solid.status() != Error.NoError or solid.is_empty():
        raise ValueError(f"the solid is none: {solid.status().name}")
    return number(abs(solid.genus()), 1)


@metric("topo_mouth_err")
def topo_mouth_err(case: Case) -> Value:
    """Rims of the open lining; two are expected."""
    edges = shell.lining_edges(case)
    rim = edges.ends[edges.faces == 1]
    if not len(rim):
        return number(2.0, 0)
    vertex, ends = np.unique(rim, return_inverse=True)
    ends = ends.reshape(-1, 2)
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(len(vertex), len(vertex)))
    return number(abs(connected_components(graph, directed=False)[0] - 2), len(rim))


@metric("topo_free_b0")
def topo_free_b0(case: Case) -> Value:
    """Pieces of free space that the centreline runs through; one is right."""
    count, cells = freespace.own_components(case)
    return number(count, cells)


@metric("topo_leak_frac")
def topo_leak_frac(case: Case) -> Value:
    """Share of rays from the axis that meet no lining and leave by neither mouth."""
    hits = shell.axis_hits(case)
    missed = np.flatnonzero(~np.isfinite(hits.distance))
    leaves = np.zeros(len(missed), bool)
    for end in (0, -1):
        leaves |= _through_mouth(case, hits.origin[missed], hits.direction[missed], end)
    return number(np.sum(~leaves) / len(hits.distance), len(hits.distance))


def _through_mouth(case: Case, origin: np.ndarray, direction: np.ndarray, end: int) -> np.ndarray:
    """Whether rays cross the plane of a mouth inside its outline, a hand's breadth of rim allowed for."""
    bore = case.candidate.bore
    middle, tangent = bore.position[end] - shell.offset(case), bore.tangent[end]
    outward = direction @ tangent * (-1.0 if end == 0 else 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = ((middle - origin) @ tangent) / (direction @ tangent)
    at = origin + np.where(np.isfinite(reach), reach, 0.0)[:, None] * direction - middle
    across, above = at @ bore.lateral[end], at @ bore.up[end]
    wall = np.interp(np.arctan2(above, across), bore.angle, bore.radius[end], period=2.0 * np.pi)
    deepest = float(np.max(case.candidate.bore.pocket["depth"], initial=0.0))
    return (outward > 0) & (np.hypot(across, above) < wall + deepest + 0.02)


@metric("topo_free_b1_err", needs="reference")
def topo_free_b1_err(case: Case) -> Value:
    """Lasting loops of the free space, candidate against reference."""
    return _lasting_difference(case, 1)


@metric("topo_free_b2_err", needs="reference")
def topo_free_b2_err(case: Case) -> Value:
    """Lasting voids, that is, bodies that float in the free space, candidate against reference."""
    return _lasting_difference(case, 2)


def _lasting_difference(case: Case, dimension: int) -> Value:
    diagrams = freespace.candidate_diagrams(case)[dimension], freespace.reference_diagrams(case)[dimension]
    made, real = (int(np.sum(d[:, 1] - d[:, 0] > _LASTING * case.tolerance)) for d in diagrams)
    return number(abs(made - real), made + real)


@metric("topo_bottleneck_h0", needs="reference")
def topo_bottleneck_h0(case: Case) -> Value:
    """Bottleneck distance of the components' diagrams of clearance, m."""
    return _bottleneck(case, 0)


@metric("topo_bottleneck_h1", needs="reference")
def topo_bottleneck_h1(case: Case) -> Value:
    """Bottleneck distance of the loops' diagrams, m."""
    return _bottleneck(case, 1)


def _bottleneck(case: Case, dimension: int) -> Value:
    import gudhi

    made, real = freespace.candidate_diagrams(case)[dimension], freespace.reference_diagrams(case)[dimension]
    return number(gudhi.bottleneck_distance(made, real), len(made) + len(real))


@metric("topo_floater_area")
def topo_floater_area(case: Case) -> Value:
    """Share of the area of lining and extra surfaces that is not in the lining's largest piece."""
    mesh, extra = shell.lining(case), case.candidate.extra
    area = np.bincount(shell.parts(mesh), weights=mesh.area_faces)
    whole = area.sum() + (extra.area if len(extra.faces) else 0.0)
    return number(1.0 - area.max() / whole, len(mesh.faces) + len(extra.faces))
