"""What is drawn of a scene folder: the lining at once, then every part of it in its own colour."""

from pathlib import Path

from subterra_jax.lidar3d.surface import LINING_KINDS, SCENES, ScenePart, joined, read_mesh, scene_parts
from subterra_jax.viewer.shapes import Colour, Shape

_CONCRETE, _BALLAST = (178, 174, 166), (124, 118, 110)
_PAINT: dict[str, Colour] = {"concrete": _CONCRETE, "floor": _BALLAST, "ballast": _BALLAST}  # textured there


def lining_shape(folder: Path, lining: str) -> Shape:
    """The whole lining as one surface, which takes a moment only.

    Raises:
        TunnelError: The mesh is missing or spoiled.
    """
    name = "lining_smooth.ply" if lining == "smooth" else "lining.ply"
    mesh = read_mesh(folder / "meshes" / name)
    return Shape("lining", mesh.vertices, mesh.faces, _CONCRETE, flat=False)


def scene_shapes(folder: Path, lining: str) -> list[Shape]:
    """Return everything that a camera sees in a scene, one shape for each material; takes seconds.

    For `smooth` it is the track alone, since the scene's walls have pockets.

    Raises:
        TunnelError: A file of the scene is missing or damaged.
    """
    groups: dict[tuple[str, str], list[ScenePart]] = {}
    for part in scene_parts(folder / SCENES[lining], LINING_KINDS if lining == "smooth" else ()):
        group = "lining" if part.kind in LINING_KINDS else "track"
        groups.setdefault((group, part.material), []).append(part)
    shapes = []
    for (group, material), parts in groups.items():
        surface = joined([part.triangles for part in parts])
        colour = _colour(parts[0])
        shapes.append(Shape(f"{group} {material}", surface.vertices, surface.faces, colour, group != "lining", group))
    return shapes


def _colour(part: ScenePart) -> Colour:
    """Return the material's own colour; for a textured one, about its texture's."""
    if part.material in _PAINT or not part.material:
        return _PAINT.get(part.material, _CONCRETE)
    red, green, blue = (round(255 * float(value)) for value in part.colour[:3])
    return red, green, blue
