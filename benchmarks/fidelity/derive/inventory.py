"""What a compiled scene holds: assets counted from its geoms, fastenings by rail seat."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive import released, shell

_PAD_HEIGHT = 0.03  # m; what is lower is a pad, what is higher a clip
_FASTENER = 0.10  # m between clip and shoulder
_REACH = 0.20  # m between parts of the fastening of one seat


def of_scene(case: Case) -> dict[str, int]:
    """Assets by the names of the manifest; a fastener is a clip with its shoulder, two to a seat."""
    model = released.model(case)
    names = [model.geom(k).name for k in range(model.ngeom)]
    pieces = fastening_pieces(released.track(case).fastening_mesh)
    pad = pieces.height <= _PAD_HEIGHT
    return {
        "sleepers": sum(name.startswith("sleeper_") for name in names),
        "rails": len({name.split("_")[1] for name in names if name.startswith("rail_")}),
        "fasteners": len(clustered(pieces.middle[~pad], _FASTENER)),
        "pads": int(pad.sum()),
        "lining_chunks": sum(name.startswith("lining") for name in names),
        "wall_panels": sum(name.startswith("wall_") for name in names),
    }


@dataclass(frozen=True)
class Pieces:
    """Connected pieces of a mesh.

    Attributes:
        middle: m, `(k, 3)`.
        height: Vertical extent, m, `(k,)`.
    """

    middle: Float[np.ndarray, "k 3"]
    height: Float[np.ndarray, " k"]


def fastening_pieces(mesh: trimesh.Trimesh) -> Pieces:
    """Pads and clips one by one."""
    if not len(mesh.faces):
        return Pieces(np.zeros((0, 3)), np.zeros(0))
    part = shell.parts(mesh)
    order = np.argsort(part, kind="stable")
    corners = mesh.triangles[order].reshape(-1, 3)
    starts = 3 * np.searchsorted(part[order], np.arange(part.max() + 1))
    low, high = np.minimum.reduceat(corners, starts), np.maximum.reduceat(corners, starts)
    return Pieces((low + high) / 2, (high - low)[:, 2])


@derived
def fastening_sets(case: Case) -> Float[np.ndarray, "k 3"]:
    """Middle of each fastening, that is, of the pieces that lie together, m."""
    return clustered(fastening_pieces(case.candidate.track.fastening_mesh).middle, _REACH)


def clustered(middle: Float[np.ndarray, "p 3"], reach: float) -> Float[np.ndarray, "k 3"]:
    """Mean of each group of points that hang together by steps of at most `reach`, m."""
    if not len(middle):
        return middle
    pair = cKDTree(middle).query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(pair), bool), (pair[:, 0], pair[:, 1])), shape=(len(middle),) * 2)
    label: Int[np.ndarray, " p"] = connected_components(graph, directed=False)[1]
    weight = np.bincount(label)[:, None]
    return np.stack([np.bincount(label, column) for column in middle.T], axis=1) / weight
