"""What is drawn of a scene folder: the lining at once, then every part of it in its own colour."""

from pathlib import Path

import numpy as np

from subterra_jax.errors import TunnelError
from subterra_jax.lidar3d.surface import Triangles, geom_triangles, joined, read_mesh
from subterra_jax.viewer.shapes import Colour, Shape

SCENES = {"smooth": "scene.xml", "pockets": "scene.xml", "furnished": "scene_furnished.xml"}
_LINING = ("lining", "recess", "floor")
_CONCRETE, _BALLAST = (178, 174, 166), (124, 118, 110)
_PAINT: dict[str, Colour] = {"concrete": _CONCRETE, "floor": _BALLAST, "ballast": _BALLAST}  # textured there
_SEEN = 1  # largest group that a camera sees


def lining_shape(folder: Path, lining: str) -> Shape:
    """The whole lining as one surface, which takes a moment only.

    Raises:
        TunnelError: The mesh is missing or spoiled.
    """
    name = "lining_smooth.ply" if lining == "smooth" else "lining.ply"
    mesh = read_mesh(folder / "meshes" / name)
    return Shape("lining", mesh.vertices, mesh.faces, _CONCRETE, flat=False)


def scene_shapes(folder: Path, lining: str) -> list[Shape]:
    """Everything that a camera sees in a scene, one shape for each material; takes seconds.

    For `smooth` it is the track alone, since the scene's walls have pockets.

    Raises:
        TunnelError: A file of the scene is missing or spoiled.
    """
    import mujoco

    path = folder / SCENES[lining]
    if not path.is_file():
        raise TunnelError(f"{path}: no such scene")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise TunnelError(f"{path}: MuJoCo refuses the scene ({error})") from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parts: dict[tuple[str, str], list[Triangles]] = {}
    for geom in np.flatnonzero(model.geom_group <= _SEEN):
        kind = model.geom(geom).name.split("_")[0]
        group = "lining" if kind in _LINING else "track"
        if group == "track" or lining != "smooth":
            material = model.mat(model.geom_matid[geom]).name if model.geom_matid[geom] >= 0 else ""
            parts.setdefault((group, material), []).append(geom_triangles(model, data, int(geom)))
    return [
        Shape(f"{group} {material}", *_arrays(triangles), _colour(model, material), group != "lining", group)
        for (group, material), triangles in parts.items()
        if any(len(part.faces) for part in triangles)
    ]


def _arrays(parts: list[Triangles]) -> tuple[np.ndarray, np.ndarray]:
    whole = joined(parts)
    return whole.vertices, whole.faces


def _colour(model: object, material: str) -> Colour:
    """The material's own colour; of a textured one, roughly its texture's."""
    if material in _PAINT or not material:
        return _PAINT.get(material, _CONCRETE)
    red, green, blue = (round(255 * float(value)) for value in model.mat(material).rgba[:3])  # type: ignore[attr-defined]
    return red, green, blue
