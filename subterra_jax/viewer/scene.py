"""Nodes of the scene in the browser: made once, then moved."""

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from subterra_jax.pictures.carrier import carrier_parts
from subterra_jax.viewer.geometry import ON_GROUND, Centreline, EpisodeGeometry, Moment, Shape

if TYPE_CHECKING:
    import trimesh

_GOAL, _BOX = (60, 200, 120), (150, 96, 60)
_BOX_HEIGHT = 1.1  # m, for looks: the recording holds no height


def add_lights(scene: viser.SceneApi) -> None:
    """Light the scene evenly, without shadows: no lamp outside would light the inside of a tunnel."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(hdri=None)
    scene.add_light_hemisphere("/light/all", sky_color=(255, 250, 242), ground_color=(120, 116, 112), intensity=2.4)
    scene.add_light_directional("/light/side", intensity=1.3, position=(0.4, -0.7, 0.6))
    scene.add_light_directional("/light/other", intensity=0.5, position=(-0.6, 0.5, 0.3))


def add_goal_gate(scene: viser.SceneApi, episode: EpisodeGeometry) -> list[viser.SceneNodeHandle]:
    """Add a gate with the goal's station; nothing without a goal."""
    posts = episode.goal()
    if not len(posts):
        return []
    text = f"goal, {episode.recording.goal:.1f} m"
    return [
        scene.add_line_segments("/goal", posts.astype(np.float32), _GOAL, thickness=0.08),
        scene.add_label("/goal label", text, position=posts[1:3, 0].mean(axis=0), anchor="bottom-center"),
    ]


def add_boxes(scene: viser.SceneApi, episode: EpisodeGeometry) -> list[viser.SceneNodeHandle]:
    """Add the obstacles."""
    plan = episode.centreline.plan
    nodes: list[viser.SceneNodeHandle] = []
    for index, (x, y, cos, sin, half_long, half_wide) in enumerate(episode.recording.boxes.astype(float)):
        ground = float(plan.elevation[np.argmin(np.sum((plan.centre - (x, y)) ** 2, axis=1))])
        nodes.append(
            scene.add_box(
                f"/boxes/{index}",
                color=_BOX,
                dimensions=(2.0 * half_long, 2.0 * half_wide, _BOX_HEIGHT),
                position=(x, y, ground + 0.5 * _BOX_HEIGHT),
                wxyz=quaternion_about_z(float(np.arctan2(sin, cos))),
                cast_shadow=False,
            )
        )
    return nodes


def quaternion_about_z(angle: float) -> tuple[float, float, float, float]:
    """Return a rotation about the vertical as a quaternion, scalar first."""
    return float(np.cos(0.5 * angle)), 0.0, 0.0, float(np.sin(0.5 * angle))


class WheeledRobot:
    """A small four-wheeled carrier with a LiDAR on a mast, as wide as the robot's footprint; `mesh` is `robot_mesh`."""

    def __init__(self, scene: viser.SceneApi, mesh: "trimesh.Trimesh"):
        self.nodes = [scene.add_mesh_trimesh("/robot", mesh, cast_shadow=False)]

    def place(self, moment: Moment) -> None:
        self.nodes[0].position, self.nodes[0].wxyz = moment.position, quaternion_about_z(moment.heading)


def robot_mesh(radius: float, lidar_height: float) -> "trimesh.Trimesh":
    """Return the mesh of a wheeled robot that stands on z = 0 and faces x.

    Args:
        radius: Radius of its footprint, m.
        lidar_height: Height of its LiDAR, m.
    """
    import trimesh  # takes half a second; the tunnel is shown first

    turned = trimesh.transformations.rotation_matrix(np.pi / 2, (1.0, 0.0, 0.0))
    parts = []
    for part in carrier_parts(radius, lidar_height):
        if part.kind == "box":
            mesh = trimesh.creation.box(2.0 * np.array(part.half))
        else:
            across = turned if part.across else None
            mesh = trimesh.creation.cylinder(part.half[0], 2.0 * part.half[1], transform=across)
        mesh.apply_translation(part.middle)
        mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=(*part.colour, 255))
        parts.append(mesh)
    whole: Any = trimesh.util.concatenate(parts)
    return whole


class LeggedRobot:
    """A Unitree B2: one node for each of its thirteen bodies, placed by MuJoCo's kinematics."""

    def __init__(self, scene: viser.SceneApi):
        import mujoco  # takes a second; most episodes have wheels

        from subterra_jax.b2.model import robot_spec

        self._kinematics = mujoco.mj_kinematics
        self._model = robot_spec().compile()
        self._data = mujoco.MjData(self._model)
        self.nodes = [
            scene.add_mesh_trimesh(f"/robot/{name}", _body_mesh(name), cast_shadow=False)
            for name in (self._model.body(body).name for body in range(1, self._model.nbody))
        ]

    def place(self, moment: Moment) -> None:
        data = self._data
        data.qpos[:2], data.qpos[2], data.qpos[3:] = moment.position[:2], moment.trunk, moment.pose
        self._kinematics(self._model, data)
        for body, node in enumerate(self.nodes, start=1):
            node.position, node.wxyz = data.xpos[body].copy(), data.xquat[body].copy()


def _body_mesh(name: str) -> Any:
    """Return the looks of one body of the B2, in its own frame."""
    import trimesh

    from subterra_jax.b2.shape import shape_of

    parts = []
    for part in shape_of(name):
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        colour = np.array([*part.colour, 1.0]) * 255.0
        mesh.visual = trimesh.visual.ColorVisuals(
            mesh, vertex_colors=np.tile(colour.astype(np.uint8), (len(mesh.vertices), 1))
        )
        parts.append(mesh)
    return trimesh.util.concatenate(parts)


TRUTH, ODOMETRY, ESTIMATE, _HIT = (64, 156, 255), (255, 120, 60), (190, 110, 255), (255, 214, 102)
_LINES_EVERY = 0.09  # s; a browser without a GPU drops lines that come more often
_LINES = ("beams", "truth", "odometry", "estimate")
# Lines reach the page later than poses. So beams and estimate hang on the robot, and so does each trail's last piece.
_CARRIED, _RECKONED = "/carried", "/reckoned"
_TAIL = 2.0  # m
_COARSE, _FINE = 0.1, 0.035  # size of the hits of sixteen beams, and of a thousand, m
_HIDDEN = np.array([[[0.0, 0.0, -100.0]] * 2])  # points of an empty set of lines, out of sight


def _tail(share: float) -> np.ndarray:
    """Return the last piece of a trail behind the robot as one segment, m; at a share of the trails' height."""
    height = share * ON_GROUND
    return np.array([[[-_TAIL, 0.0, height], [0.0, 0.0, height]]], np.float32)


class SceneView:
    """All nodes of the scene; any thread may change them."""

    def __init__(self, server: viser.ViserServer):
        self._server, self._lock = server, threading.RLock()
        self._shapes: dict[str, list[viser.MeshHandle]] = {"lining": [], "track": []}
        self._episode_nodes: list[viser.SceneNodeHandle] = []
        self._row: tuple[EpisodeGeometry, int] | None = None
        self._lines_at = 0.0
        self._made = 0  # tunnels so far, part of their nodes' names: the old one stays until the new one is complete
        self.visible = {name: True for name in ("lining", "track", *_LINES)}
        server.scene.world_axes.visible = False
        add_lights(server.scene)
        self._robot: WheeledRobot | LeggedRobot | None = None
        self._ghost: viser.MeshHandle | None = None
        colours = {"beams": _HIT, "truth": TRUTH, "odometry": ODOMETRY, "estimate": ESTIMATE}
        self._frames = {name: server.scene.add_frame(name, show_axes=False) for name in (_CARRIED, _RECKONED)}
        self._lines = {
            name: server.scene.add_line_segments(
                f"{_CARRIED}/{name}" if name in ("beams", "estimate") else f"/{name}",
                _HIDDEN,
                colours[name],
                thickness=0.02 if name == "beams" else 0.07,
            )
            for name in _LINES
        }
        self._tails = {
            name: server.scene.add_line_segments(f"{frame}/tail", _tail(share), colours[name], thickness=0.07)
            for name, frame, share in (("truth", _CARRIED, 1.0), ("odometry", _RECKONED, 0.6))
        }
        self._hits = self._points(f"{_CARRIED}/hits", _HIT, _COARSE)
        self._particles = self._points(f"{_CARRIED}/particles", ESTIMATE, 0.07)

    def _points(self, name: str, colour: tuple[int, int, int], size: float) -> viser.PointCloudHandle:
        return self._server.scene.add_point_cloud(
            name,
            _HIDDEN[:, 0],
            colour,
            point_size=size,
            point_shape="circle",
            precision="float32",
            point_shading="flat",
        )

    def set_tunnel(self, shapes: list[Shape], *, cutaway: bool) -> None:
        """Show another tunnel, or the same in more detail.

        Args:
            shapes: Surfaces of the tunnel.
            cutaway: Draw walls from within only, so that the tunnel is open to a camera outside.
        """
        made: dict[str, list[viser.MeshHandle]] = {"lining": [], "track": []}
        with self._lock, self._server.atomic():
            old = [handle for group in self._shapes.values() for handle in group]
            self._made += 1
            for index, shape in enumerate(shapes):
                handle = self._server.scene.add_mesh_simple(
                    f"/tunnel/{self._made}/{index} {shape.name}",
                    shape.vertices.astype(np.float32),
                    shape.faces.astype(np.uint32),
                    color=shape.colour,
                    flat_shading=shape.flat,
                    side="front" if cutaway or shape.group == "track" else "double",
                    cast_shadow=False,
                    receive_shadow=False,
                    visible=self.visible[shape.group],
                )
                made[shape.group].append(handle)
            for handle in old:
                handle.remove()
            self._shapes = made

    def set_cutaway(self, cutaway: bool) -> None:
        """Draw walls from within only, or from both sides."""
        for handle in self._shapes["lining"]:
            handle.side = "front" if cutaway else "double"

    def set_visible(self, name: str, visible: bool) -> None:
        """Show or hide a part: `lining`, `track`, `beams`, `truth`, `odometry` or `estimate`."""
        self.visible[name] = visible
        for handle in self._shapes.get(name, []):
            handle.visible = visible
        others: dict[str, list[viser.SceneNodeHandle | None]] = {
            "beams": [self._hits],
            "estimate": [self._particles],
            "odometry": [self._ghost, self._tails["odometry"]],
            "truth": [self._tails["truth"]],
        }
        for node in [self._lines.get(name), *others.get(name, [])]:
            if node is not None:
                node.visible = visible

    def set_episode(self, episode: EpisodeGeometry, centreline: Centreline) -> None:
        """Replace the robot, its dead-reckoned ghost, the goal and the boxes by those of another episode."""
        recording, height = episode.recording, centreline.plan.lidar_height
        with self._lock, self._server.atomic():
            for node in self._episode_nodes:
                node.remove()
            scene = self._server.scene
            mesh = robot_mesh(recording.radius, height)
            walks = recording.pose.shape[1] > 0
            self._hits.point_size = _FINE if recording.points.shape[1] else _COARSE
            self._robot = LeggedRobot(scene) if walks else WheeledRobot(scene, mesh)
            self._ghost = scene.add_mesh_simple(
                "/ghost",
                np.asarray(mesh.vertices, np.float32),
                np.asarray(mesh.faces, np.uint32),
                color=ODOMETRY,
                opacity=0.45,
                cast_shadow=False,
                visible=self.visible["odometry"],
            )
            self._episode_nodes = [
                *self._robot.nodes,
                self._ghost,
                *add_goal_gate(self._server.scene, episode),
                *add_boxes(self._server.scene, episode),
            ]
            self._row = None

    def show(self, episode: EpisodeGeometry, moment: Moment, full: bool) -> None:
        """Show one moment; lines and points, which change only with the rows, every `_LINES_EVERY` or if `full`."""
        with self._lock, self._server.atomic():
            if self._robot is None or self._ghost is None:
                return
            self._robot.place(moment)
            self._ghost.position, self._ghost.wxyz = moment.odometry, quaternion_about_z(moment.odometry_heading)
            self._carry(episode, moment)
            now = time.monotonic()
            if full or (self._row != (episode, moment.row) and now - self._lines_at >= _LINES_EVERY):
                self._row, self._lines_at = (episode, moment.row), now
                self._show_row(episode, moment)

    def _carry(self, episode: EpisodeGeometry, moment: Moment) -> None:
        """Move what hangs on the robot and on its dead-reckoned ghost; no tail is longer than the way so far."""
        truth, odometry = self._frames[_CARRIED], self._frames[_RECKONED]
        truth.position, truth.wxyz = moment.position, quaternion_about_z(moment.heading)
        odometry.position, odometry.wxyz = moment.odometry, quaternion_about_z(moment.odometry_heading)
        long_enough = episode.way(moment.row) > _TAIL
        for name, tail in self._tails.items():
            if tail.visible != (visible := long_enough and self.visible[name]):
                tail.visible = visible

    def _show_row(self, episode: EpisodeGeometry, moment: Moment) -> None:
        beams, _ = episode.beams(moment.row)
        truth, odometry = episode.trails(moment)
        lines = {
            "beams": beams,
            "truth": truth,
            "odometry": odometry,
            "estimate": episode.carried(moment.row, episode.ellipse(moment.row)),
        }
        for name, segments in lines.items():
            self._lines[name].points = (segments if len(segments) else _HIDDEN).astype(np.float32)
        for cloud, points in (
            (self._hits, episode.returns(moment.row)),
            (self._particles, episode.carried(moment.row, episode.particles(moment.row))),
        ):
            cloud.points = (points if len(points) else _HIDDEN[:, 0]).astype(np.float32)
