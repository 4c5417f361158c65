"""A Unitree B2 as it is drawn: one node for each of its thirteen bodies, placed by MuJoCo's kinematics."""

from typing import Any

import numpy as np
import viser

from subterra_jax.viewer.frames import Frame


class Legged:
    """The robot on a stage.

    Args:
        scene: Where it is drawn.

    Attributes:
        nodes: One for each body.
    """

    def __init__(self, scene: viser.SceneApi):
        import mujoco  # takes a second, and most episodes roll

        from subterra_jax.b2.model import robot_spec

        self._kinematics = mujoco.mj_kinematics
        self._model = robot_spec().compile()
        self._data = mujoco.MjData(self._model)
        self.nodes = [
            scene.add_mesh_trimesh(f"/robot/{self._model.body(body).name}", _mesh(self._model, body), cast_shadow=False)
            for body in range(1, self._model.nbody)
        ]

    def place(self, frame: Frame) -> None:
        """Puts it where it is at a moment."""
        data = self._data
        data.qpos[:2], data.qpos[2], data.qpos[3:] = frame.position[:2], frame.trunk, frame.pose
        self._kinematics(self._model, data)
        for body, node in enumerate(self.nodes, start=1):
            node.position, node.wxyz = data.xpos[body].copy(), data.xquat[body].copy()


def _mesh(model: Any, body: int) -> Any:
    """All that is drawn of one body, in its own frame."""
    import trimesh

    parts = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        part = _primitive(int(model.geom_type[geom]), model.geom_size[geom])
        turn = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])
        turn[:3, 3] = model.geom_pos[geom]
        part.apply_transform(turn)
        part.visual = trimesh.visual.ColorVisuals(part, face_colors=(255.0 * model.geom_rgba[geom]).astype(np.uint8))
        parts.append(part)
    return trimesh.util.concatenate(parts)


def _primitive(kind: int, size: np.ndarray) -> Any:
    """A box, cylinder, capsule or sphere about the origin."""
    import mujoco
    import trimesh

    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(2.0 * size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=24)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(2.0 * size[1], size[0], count=[12, 12])
    return trimesh.creation.icosphere(2, size[0])
