"""The wheeled robot of the planar tasks, for pictures: a hull on four wheels with a LiDAR on a mast."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

_HULL, _WHEEL, _MAST, _SENSOR = (226, 106, 24), (38, 38, 42), (92, 94, 100), (30, 34, 40)
_WHEEL_RADIUS = 0.4  # of the robot's radius


class Part(NamedTuple):
    """One box or cylinder of the robot, in its frame: x ahead, y to the left, z up from the ground.

    Attributes:
        kind: `box` or `cylinder`.
        half: Half sizes of a box; radius and half length of a cylinder, m.
        middle: Middle, m.
        colour: Red, green, blue, 0 to 255.
        across: Turned so that a cylinder's axis points to the left; else it points upwards.
    """

    kind: str
    half: tuple[float, ...]
    middle: tuple[float, float, float]
    colour: tuple[int, int, int]
    across: bool = False


def carrier_parts(radius: float, lidar_height: float) -> list[Part]:
    """Return the parts of a robot that stands on z = 0 and faces x.

    Args:
        radius: Radius of its footprint, m.
        lidar_height: Height of its LiDAR, m.
    """
    deck = 0.95 * radius
    top = max(lidar_height, deck + 0.2)
    wheel = (_WHEEL_RADIUS * radius, 0.125 * radius)
    return [
        Part("box", (0.75 * radius, 0.475 * radius, 0.225 * radius), (0.0, 0.0, 0.75 * radius), _HULL),
        Part("box", (0.125 * radius, 0.3 * radius, 0.1 * radius), (0.8 * radius, 0.0, deck), _SENSOR),
        Part("cylinder", (0.06 * radius, 0.5 * (top - deck)), (0.0, 0.0, 0.5 * (top + deck)), _MAST),
        Part("cylinder", (0.22 * radius, 0.05), (0.0, 0.0, top), _SENSOR),
        *(
            Part("cylinder", wheel, (x * radius, y * radius, wheel[0]), _WHEEL, across=True)
            for x in (-0.5, 0.5)
            for y in (-0.6, 0.6)
        ),
    ]


def add_carrier(
    scene: Any, ground: Float[np.ndarray, "3"], heading: float, pitch: float, radius: float, lidar_height: float
) -> None:
    """Add the robot to an abstract MuJoCo scene that is about to be drawn.

    Args:
        scene: `mujoco.MjvScene`, after `update_scene`.
        ground: Point below the robot's middle, m.
        heading: Heading in plan, rad.
        pitch: Slope of the ground ahead, rad; positive rises.
        radius: Radius of the footprint, m.
        lidar_height: Height of the LiDAR, m.
    """
    import mujoco

    cos, sin, level, rise = np.cos(heading), np.sin(heading), np.cos(pitch), np.sin(pitch)
    ahead, left = np.array([level * cos, level * sin, rise]), np.array([-sin, cos, 0.0])
    axes = np.stack([ahead, left, np.cross(ahead, left)], axis=-1)
    kinds = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}
    for part in carrier_parts(radius, lidar_height):
        turn = axes[:, [2, 0, 1]] if part.across else axes
        half = (*part.half, 0.0)[:3]
        colour = np.array([*part.colour, 255], np.float32) / np.float32(255)
        middle = ground + axes @ np.array(part.middle)
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kinds[part.kind], np.array(half), middle, turn.ravel(), colour)
        scene.ngeom += 1
