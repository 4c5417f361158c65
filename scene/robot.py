"""The round robot that a scene comes with, as URDF: the same shapes, mass and inertia as in the MJCF."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np

from scene.errors import RecordingError, require_input
from scene.writing.markup import write_xml

_NAME = "scout"


def write_urdf(path: Path, scene: Path, comment: str) -> None:
    """Write the robot of a scene's MJCF: `base_link` with all its shapes, and the frame `lidar` on a fixed joint.

    URDF has no capsule: it becomes a cylinder between two balls. There is no free joint either; programs that load URDF
    give the base one. `comment` is kept in the file. Raises `RecordingError` for no MJCF, or one without such a robot.
    """
    body = _read_body(scene)
    model = _compile(body)
    robot = ET.Element("robot", name=_NAME)
    robot.append(ET.Comment(f" {comment.replace('--', '- -')} "))
    material = ET.SubElement(robot, "material", name="hull")
    ET.SubElement(material, "color", rgba="0.90 0.42 0.08 1")
    base = ET.SubElement(robot, "link", name="base_link")
    number = model.body(_NAME).id
    inertial = ET.SubElement(base, "inertial")
    _place(inertial, model.body_ipos[number], model.body_iquat[number])
    ET.SubElement(inertial, "mass", value=_text(model.body_mass[number]))
    x, y, z = (_text(value) for value in model.body_inertia[number])
    ET.SubElement(inertial, "inertia", ixx=x, iyy=y, izz=z, ixy="0", ixz="0", iyz="0")
    for geom in range(model.ngeom):
        _add_shapes(base, model, geom)
    for site in range(model.nsite):
        name = model.site(site).name
        ET.SubElement(robot, "link", name=name)
        joint = ET.SubElement(robot, "joint", name=f"{name}_joint", type="fixed")
        _place(joint, model.site_pos[site], model.site_quat[site])
        ET.SubElement(joint, "parent", link="base_link")
        ET.SubElement(joint, "child", link=name)
    write_xml(path, robot)


def _read_body(scene: Path) -> ET.Element:
    """Return the element of the robot."""
    try:
        root = ET.parse(require_input(scene)).getroot()
    except ET.ParseError as error:
        raise RecordingError(f"{scene}: not a readable scene ({error})") from error
    body = next((one for one in root.iter("body") if one.get("name") == _NAME), None)
    if body is None:
        raise RecordingError(f"{scene}: has no robot {_NAME!r}; build the scene again with scene.build")
    return body


def _compile(body: ET.Element) -> mujoco.MjModel:
    """Compile the robot alone, about its own frame, without the scene's materials."""
    root = ET.Element("mujoco")
    own = ET.SubElement(ET.SubElement(root, "worldbody"), "body", name=_NAME)
    for part in body:
        kept = {key: value for key, value in part.attrib.items() if key not in ("material", "class")}
        if part.tag != "camera":
            ET.SubElement(own, part.tag, kept)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def _add_shapes(link: ET.Element, model: mujoco.MjModel, geom: int) -> None:
    """Add a geom to a link, for looks and for collisions."""
    kind, size, turn = model.geom_type[geom], model.geom_size[geom], np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    middle, axis = model.geom_pos[geom], turn.reshape(3, 3)[:, 2]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        shapes = [("sphere", {"radius": _text(size[0])}, middle)]
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        ball = {"radius": _text(size[0])}
        shapes = [("cylinder", {**ball, "length": _text(2.0 * size[1])}, middle)]
        shapes += [("sphere", ball, middle + side * size[1] * axis) for side in (1.0, -1.0)]
    else:
        raise RecordingError(f"the robot's geom {model.geom(geom).name!r} is of a kind that URDF is not written for")
    for name, attributes, place in shapes:
        for use in ("visual", "collision"):
            part = ET.SubElement(link, use)
            _place(part, place, model.geom_quat[geom])
            ET.SubElement(ET.SubElement(part, "geometry"), name, attributes)
            if use == "visual":
                ET.SubElement(part, "material", name="hull")


def _place(element: ET.Element, position: np.ndarray, quaternion: np.ndarray) -> None:
    """Add the origin of an element: position, m, and roll, pitch and yaw, rad."""
    w, x, y, z = quaternion
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    words = (" ".join(_text(value) for value in values) for values in (position, (roll, pitch, yaw)))
    ET.SubElement(element, "origin", dict(zip(("xyz", "rpy"), words, strict=True)))


def _text(value: float) -> str:
    return f"{value:.9g}"
