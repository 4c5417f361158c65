"""Rays in the compiled scene and in the meshes that it was made from."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import released, surface
from benchmarks.fidelity.derive.released import of_released

LINING = ("lining", "recess", "floor")  # what pieces of the lining are called
VISIBLE = np.array([1, 1, 1, 0, 0, 0], np.uint8)  # groups that a camera draws
_OURS = {"bed", *LINING, "sleeper", "rail", "fastening", "fastenings"}  # what geoms of lining and track are called
_EYES = 100
_RAYS = 1000


@dataclass(frozen=True)
class Pairs:
    """Ranges of the same rays.

    Attributes:
        scene: By MuJoCo, m; `inf` for none, `(k,)`.
        mesh: By embree in lining and track, m; `inf` for none, `(k,)`.
        comparable: Whether what MuJoCo hit is among those meshes, `(k,)`.
    """

    scene: Float[np.ndarray, " k"]
    mesh: Float[np.ndarray, " k"]
    comparable: Bool[np.ndarray, " k"]


@of_released("scene", "mesh")
def from_axis(case: Case) -> Pairs:
    """Rays all around from random places of the centreline."""
    _, eye, _ = released.along_axis(case, "mj_ray_vs_mesh_mae", _EYES)
    way = case.rng("mj_ray_leak_rate").normal(size=(_EYES, _RAYS, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    return pairs(case, eye, way)


def pairs(case: Case, eye: Float[np.ndarray, "e 3"], way: Float[np.ndarray, "e r 3"]) -> Pairs:
    """Casts rays from eyes in both."""
    model = released.model(case)
    reach, geom = scene_ranges(model, eye, way)
    flat = way.reshape(-1, 3)
    mesh = surface.intersector(case).first(np.repeat(eye, way.shape[1], axis=0), flat)[0]
    # Nails and lamps are of the scene alone.
    ours = np.array([model.geom(k).name.split("_")[0] in _OURS for k in range(model.ngeom)] + [True])
    return Pairs(reach, mesh, ours[geom])


def scene_ranges(
    model: mujoco.MjModel, eye: Float[np.ndarray, "e 3"], way: Float[np.ndarray, "e r 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges by `mj_multiRay` in what is drawn, robot left out, m, `inf` for none, and the geoms hit, `(e·r,)` each."""
    data = released.placed(model)
    try:
        robot = released.robot(model)
    except ValueError:
        robot = -1
    count = way.shape[1]
    reach, geom = np.empty((len(eye), count)), np.empty((len(eye), count), np.int32)
    for row in range(len(eye)):
        mujoco.mj_multiRay(
            model, data, eye[row], np.ascontiguousarray(way[row]).ravel(), VISIBLE, True, robot, geom[row], reach[row],
            None, count, mujoco.mjMAXVAL,
        )  # fmt: skip
    return np.where(reach < 0.0, np.inf, reach).ravel(), geom.ravel()
