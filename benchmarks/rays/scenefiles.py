"""What a scene folder holds that rays can be compared in."""

from pathlib import Path

from benchmarks.rays.errors import RaysError
from subterra_jax.lidar3d.surface import SMALL, Triangles, joined, read_mesh, read_scene
from subterra_jax.tunnel.plan import TunnelPlan

DEFAULT_SCENE = Path("build/subterra-351")
_WHOLE = {"smooth": "lining_smooth.ply", "pockets": "lining.ply"}
_LINING_PARTS = ("lining", "recess", "floor")


def require_scene(folder: Path) -> Path:
    """The folder itself, once it is known to hold a built scene.

    Raises:
        RaysError: It does not.
    """
    for name in ("tunnel.npz", "bore.npz", "scene.xml", "meshes/lining.ply"):
        if not (folder / name).is_file():
            raise RaysError(f"{folder}: is no built scene: {name} is missing (`python -m scene.build` makes one)")
    return folder


def meshed_linings(folder: Path, plan: TunnelPlan) -> list[str]:
    """The linings of a plan of which the folder has a mesh."""
    there = {name: (folder / "meshes" / file).is_file() for name, file in _WHOLE.items()}
    there["furnished"] = (folder / "scene_furnished.xml").is_file()
    return [name for name in plan.linings if there.get(name, False)]


def reference_surface(folder: Path, lining: str) -> Triangles:
    """What embree sees of one lining: the mesh of its walls, and what else the scene draws but bolts and clips."""
    if lining not in _WHOLE:
        return read_scene(folder, lining)
    walls = read_mesh(folder / "meshes" / _WHOLE[lining])
    return joined([walls, read_scene(folder, "pockets", (*SMALL, *_LINING_PARTS))])
