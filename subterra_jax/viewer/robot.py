"""The robot as it is drawn: a small four-wheeled carrier with a LiDAR on a mast, as wide as its footprint."""

from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from subterra_jax.viewer.frames import Frame
from subterra_jax.viewer.props import about_z

if TYPE_CHECKING:
    import trimesh

_HULL, _WHEEL, _MAST, _SENSOR = (226, 106, 24), (38, 38, 42), (92, 94, 100), (30, 34, 40)
_WHEEL_RADIUS = 0.4  # of the robot's radius


class Carrier:
    """The robot on a stage.

    Args:
        scene: Where it is drawn.
        mesh: As `robot_mesh` makes it.

    Attributes:
        nodes: Its one node.
    """

    def __init__(self, scene: viser.SceneApi, mesh: "trimesh.Trimesh"):
        self.nodes = [scene.add_mesh_trimesh("/robot", mesh, cast_shadow=False)]

    def place(self, frame: Frame) -> None:
        """Puts it where it is at a moment."""
        self.nodes[0].position, self.nodes[0].wxyz = frame.position, about_z(frame.heading)


def robot_mesh(radius: float, lidar_height: float) -> "trimesh.Trimesh":
    """A robot that stands on z = 0 and faces x.

    Args:
        radius: Radius of its footprint, m.
        lidar_height: Height of its LiDAR, m.
    """
    import trimesh  # takes half a second, and the tunnel is to be seen first

    wheel, deck = _WHEEL_RADIUS * radius, 0.95 * radius
    top = max(lidar_height, deck + 0.2)
    parts = [
        _painted(trimesh.creation.box((1.5 * radius, 0.95 * radius, 0.45 * radius)), (0.0, 0.0, 0.75 * radius), _HULL),
        _painted(trimesh.creation.box((0.25 * radius, 0.6 * radius, 0.2 * radius)), (0.8 * radius, 0.0, deck), _SENSOR),
        _painted(trimesh.creation.cylinder(0.06 * radius, top - deck), (0.0, 0.0, 0.5 * (top + deck)), _MAST),
        _painted(trimesh.creation.cylinder(0.22 * radius, 0.1), (0.0, 0.0, top), _SENSOR),
    ]
    turned = trimesh.transformations.rotation_matrix(np.pi / 2, (1.0, 0.0, 0.0))
    for x in (-0.5, 0.5):
        for y in (-0.6, 0.6):
            tyre = trimesh.creation.cylinder(wheel, 0.25 * radius, transform=turned)
            parts.append(_painted(tyre, (x * radius, y * radius, wheel), _WHEEL))
    whole: Any = trimesh.util.concatenate(parts)
    return whole


def _painted(part: Any, middle: tuple[float, float, float], colour: tuple[int, int, int]) -> Any:
    import trimesh

    part.apply_translation(middle)
    part.visual = trimesh.visual.ColorVisuals(part, face_colors=(*colour, 255))
    return part
