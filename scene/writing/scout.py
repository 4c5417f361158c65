"""The round robot of the environment, with its LiDAR's place and its cameras."""

from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from scene.bore import Bore
from scene.writing.markup import DECK, LOW_WALL, child, numbers, quaternion
from scene.writing.track import Track


def add_scout(world: ET.Element, bore: Bore, track: Track, radius: float, lidar_height: float) -> None:
    """A robot on four smooth casters, 2 m into the bore; its LiDAR `lidar_height` above the top of the sleepers, m."""
    at = bore.axis.at(np.array([min(2.0, bore.length / 2)]))
    elevation = float(np.interp(at.station[0], bore.station, track.elevation))
    yaw = Rotation.from_euler("z", np.arctan2(at.tangent[0, 1], at.tangent[0, 0]))
    body = child(
        world, "body", name="scout", pos=numbers([*at.position[0, :2], elevation + 0.01]), quat=quaternion(yaw)
    )
    child(body, "freejoint", name="scout")
    touch = {"contype": "0", "conaffinity": str(LOW_WALL | DECK), "group": "2", "material": "scout"}
    hull = {"type": "capsule", "size": numbers([radius, 0.08]), "pos": "0 0 0.52", "mass": "40"}
    child(body, "geom", name="scout_hull", **hull, **touch)
    for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        child(
            body, "geom", name=f"scout_caster_{k}", type="sphere", size="0.08",
            pos=numbers([0.22 * x, 0.22 * y, 0.08]), mass="1", friction="0.05 0.005 0.0001", **touch,
        )  # fmt: skip
    child(body, "site", name="lidar", pos=numbers([0, 0, lidar_height]), size="0.03")
    child(body, "camera", name="scout", pos="0 0 1.0", xyaxes="0 -1 0 0.1 0 1", fovy="70")
    child(body, "camera", name="chase", pos="-4.0 0 2.2", xyaxes="0 -1 0 0.22 0 1", fovy="60")
