"""What MuJoCo casts rays in: a scene folder as it was built, or the walls of a plan, extruded in memory."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from benchmarks.throughput.errors import ThroughputError
from subterra_jax.tunnel.plan import TunnelPlan

_HALF_HEIGHT = 1.0  # of extruded walls above and below the LiDAR, m


@dataclass(frozen=True)
class Scene:
    """A compiled scene with every geom in its place.

    Attributes:
        model: The model.
        data: Its first pose.
        height: Height of the LiDAR at each node of the plan's chainage grid, m.
        about: What it is, for people.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    height: Float[np.ndarray, " n"]
    about: str


def extruded(plan: TunnelPlan, lining: str) -> Scene:
    """Upright walls over every segment of a lining, as one mesh."""
    segments = plan.lining(lining).segments
    segments = segments[np.any(segments[:, :2] != segments[:, 2:], axis=1)]
    low, high = np.full((len(segments), 1), -_HALF_HEIGHT), np.full((len(segments), 1), _HALF_HEIGHT)
    start, end = segments[:, :2], segments[:, 2:]
    vertex = np.stack([np.hstack(pair) for pair in ((start, low), (end, low), (end, high), (start, high))], axis=1)
    face = (4 * np.arange(len(segments))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="walls", uservert=vertex.ravel(), userface=face.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open: it has no volume
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="walls", contype=0, conaffinity=0)
    return _placed(spec.compile(), np.zeros(len(plan.station)), f"walls of {plan.name}, extruded")


def built(folder: Path, plan: TunnelPlan, lining: str) -> Scene:
    """A scene folder's model.

    Args:
        folder: As `scene.build` writes it.
        plan: The tunnel of the same folder.
        lining: `furnished` takes the furnished scene.

    Raises:
        ThroughputError: The scene is not there, or MuJoCo cannot read it.
    """
    path = folder / ("scene_furnished.xml" if lining == "furnished" else "scene.xml")
    if not path.is_file():
        raise ThroughputError(f"{path}: no such scene")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ThroughputError(f"{path}: MuJoCo cannot read it ({str(error).splitlines()[0]})") from error
    return _placed(model, plan.elevation + plan.lidar_height, str(path))


def _placed(model: mujoco.MjModel, height: Float[np.ndarray, " n"], what: str) -> Scene:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Scene(model, data, height, f"{what}; {model.ngeom:,} geoms, {model.nmeshface:,} faces")
