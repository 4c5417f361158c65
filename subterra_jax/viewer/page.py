"""One HTML file that plays an episode: the camera rides behind the robot, and the tunnel moves past it.

viser's own player has play, pause, speed, time and a tree of what is shown. It cannot move the camera. So the robot
stays where it is, and everything else hangs on a frame that moves the other way.
"""

from __future__ import annotations

import contextlib
import html
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import viser
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from subterra_jax.host.files import replace_file
from subterra_jax.pictures.stage import carrier_parts
from subterra_jax.viewer.chart import ESTIMATE, ODOMETRY, TRUTH, error_chart, rgb
from subterra_jax.viewer.episode import ON_GROUND, Drawn
from subterra_jax.viewer.shapes import Shape

_HIT, _GOAL, _BOX = (255, 214, 102), (60, 200, 120), (150, 96, 60)
_BOX_HEIGHT = 1.1  # m, for looks: an obstacle has no height
_FRAMES = 3  # poses a control period: a page plays 30 in a second of the episode
_STATUS_EVERY = 5  # rows
_TRAIL = 10  # rows in a piece of a trail
_MOST_BEAMS = 64  # that are drawn as lines
_FINE, _COARSE = 0.035, 0.1  # size of the hits of a thousand beams, and of sixteen, m
_PANEL = (
    "position:fixed;top:0;left:0;margin:0.6em;padding:0.6em 0.9em;z-index:9;font:13px/1.45 sans-serif;color:#ddd;"
    "background:rgba(20,20,24,0.78);border-radius:4px;pointer-events:none"
)


def write_page(path: Path, drawn: Drawn, shapes: list[Shape], radius: float, facts: dict[str, str]) -> None:
    """Write the page of an episode.

    Args:
        path: The HTML file; it holds everything and needs no server.
        shapes: Surfaces of its tunnel.
        radius: Radius of the robot's footprint, m.
        facts: Words about it, as `task` and `driver`, for the panel.

    Raises:
        OutputError: The file cannot be written.
    """
    with _server() as server:
        player = _Player(server, drawn, shapes, radius)
        serializer = server.get_scene_serializer()
        for row in range(len(drawn)):
            player.show(row)
            for step in range(_FRAMES if row + 1 < len(drawn) else 1):
                player.move(row, step / _FRAMES)
                serializer.insert_sleep(drawn.trace.period / _FRAMES)
        page = serializer.as_html(dark_mode=True)
    with replace_file(path) as part:
        part.write_text(page.replace("</body>", f"{_panel(drawn, facts)}</body>"))


@contextlib.contextmanager
def _server() -> Iterator[viser.ViserServer]:
    """Yield a server of this machine alone, which nobody visits: it only gathers what the page will show."""
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            yield server
        finally:
            server.stop()


class _Player:
    """The nodes of a page."""

    def __init__(self, server: viser.ViserServer, drawn: Drawn, shapes: list[Shape], radius: float):
        self._scene, self._drawn = server.scene, drawn
        server.initial_camera.position, server.initial_camera.look_at = (-3.6, 0.0, 1.9), (3.0, 0.0, 0.7)
        _light(server.scene)
        self._world = server.scene.add_frame("/world", show_axes=False)
        for shape in shapes:
            server.scene.add_mesh_simple(
                f"/world/tunnel/{shape.name}", shape.vertices.astype(np.float32), shape.faces.astype(np.uint32),
                color=shape.colour, flat_shading=True, side="front", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._beams = self._lines("/beams", np.zeros((1, 2, 3)), _HIT, 0.02)
        self._hits = self._points("/hits", _HIT, _FINE if drawn.hits.shape[1] > _MOST_BEAMS else _COARSE)
        self._particles = self._points("/world/particles", ESTIMATE, 0.07)
        self._ellipse = self._lines("/world/estimate", np.zeros((1, 2, 3)), ESTIMATE, 0.07)
        self._status = server.scene.add_label("/status", "", position=(-1.0, 0.0, 0.0), anchor="top-center")
        lidar = drawn.centreline.plan.lidar_height
        mesh, walks = _carrier(radius, lidar), drawn.trace.pose.shape[1] > 0
        self._legs = _Legs(server.scene) if walks else None
        if not walks:
            server.scene.add_mesh_trimesh("/robot", mesh, cast_shadow=False)
        self._ghost = server.scene.add_mesh_simple(
            "/world/odometry/robot", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32),
            color=ODOMETRY, opacity=0.45, cast_shadow=False,
        )  # fmt: skip
        self._add_goal()
        self._add_boxes()

    def show(self, row: int) -> None:
        """Show what changes with the rows."""
        drawn = self._drawn
        hits = drawn.hits[row].astype(np.float64)
        hits = hits[np.isfinite(hits).all(axis=1)]
        self._hits.points = _seen(hits)
        if drawn.hits.shape[1] <= _MOST_BEAMS:
            lidar = np.broadcast_to([0.0, 0.0, drawn.centreline.plan.lidar_height], hits.shape)
            self._beams.points = _seen(np.stack([lidar, hits], axis=1))
        self._ellipse.points, self._particles.points = _seen(drawn.ellipse(row)), _seen(drawn.particles(row))
        if (row and row % _TRAIL == 0) or row == len(drawn) - 1:
            self._add_trails(row)
        if row % _STATUS_EVERY == 0 or row == len(drawn) - 1:
            self._status.text = _status(drawn, row)

    def move(self, row: int, fraction: float) -> None:
        """Move the tunnel past the robot, to a fraction of the way to the next row."""
        position, heading = self._drawn.pose(row + fraction)
        back = Rotation.from_euler("z", -heading)
        self._world.position, self._world.wxyz = -back.apply(position), _about_z(-heading)
        position, heading = self._drawn.pose(row + fraction, reckoned=True)
        self._ghost.position, self._ghost.wxyz = position, _about_z(heading)
        if self._legs is not None:
            poses = self._drawn.trace.pose[min(row + 1, len(self._drawn) - 1)]
            self._legs.place(poses[min(int(fraction * len(poses)), len(poses) - 1)])

    def _add_trails(self, row: int) -> None:
        rows = np.arange(row - 1 - (row - 1) % _TRAIL, row + 1)
        for name, places, colour, above in (
            ("truth", self._drawn.truth, TRUTH, ON_GROUND),
            ("odometry", self._drawn.reckoned, ODOMETRY, 0.6 * ON_GROUND),  # so that they do not flicker
        ):
            points = places[rows] + np.array([0.0, 0.0, above])
            if len(points) > 1:
                self._lines(f"/world/{name}/{row}", np.stack([points[:-1], points[1:]], axis=1), colour, 0.07)

    def _add_goal(self) -> None:
        gate = self._drawn.gate()
        if len(gate):
            self._lines("/world/goal", gate, _GOAL, 0.08)
            words, place = f"goal, {self._drawn.goal:.1f} m", gate[1:3, 0].mean(axis=0)
            self._scene.add_label("/world/goal/label", words, position=place, anchor="bottom-center")

    def _add_boxes(self) -> None:
        plan = self._drawn.centreline.plan
        for index, (x, y, cos, sin, half_long, half_wide) in enumerate(self._drawn.boxes.astype(float)):
            ground = float(plan.elevation[np.argmin(np.sum((plan.centre - (x, y)) ** 2, axis=1))])
            self._scene.add_box(
                f"/world/boxes/{index}", color=_BOX, dimensions=(2.0 * half_long, 2.0 * half_wide, _BOX_HEIGHT),
                position=(x, y, ground + 0.5 * _BOX_HEIGHT), wxyz=_about_z(float(np.arctan2(sin, cos))),
                cast_shadow=False,
            )  # fmt: skip

    def _lines(self, name: str, segments: Float[np.ndarray, "n 2 3"], colour: Any, thickness: float) -> Any:
        return self._scene.add_line_segments(name, segments.astype(np.float32), colour, thickness=thickness)

    def _points(self, name: str, colour: Any, size: float) -> Any:
        return self._scene.add_point_cloud(name, _seen(np.zeros((0, 3))), colour, point_size=size, point_shape="circle")


class _Legs:
    """A Unitree B2: one node for each of its thirteen bodies, placed by MuJoCo's kinematics."""

    def __init__(self, scene: viser.SceneApi):
        import mujoco  # takes a second; most episodes have wheels

        from subterra_jax.b2.model import robot_spec
        from subterra_jax.b2.shape import shape_of

        self._kinematics, self._model = mujoco.mj_kinematics, robot_spec().compile()
        self._data = mujoco.MjData(self._model)
        self._nodes = []
        for body in range(1, self._model.nbody):
            parts = shape_of(name := self._model.body(body).name)
            self._nodes.append(scene.add_mesh_trimesh(f"/world/robot/{name}", _painted(parts), cast_shadow=False))

    def place(self, pose: Float[np.ndarray, 19]) -> None:
        """Place the bodies: position, quaternion w, x, y, z and joints in the tunnel frame, m and rad."""
        self._data.qpos[:] = pose
        self._kinematics(self._model, self._data)
        for body, node in enumerate(self._nodes, start=1):
            node.position, node.wxyz = self._data.xpos[body].copy(), self._data.xquat[body].copy()


def _carrier(radius: float, lidar_height: float) -> trimesh.Trimesh:
    """Return the mesh of a wheeled robot that stands on z = 0 and faces x, m."""
    meshes = []
    for part in carrier_parts(radius, lidar_height):
        if part.kind == "box":
            mesh = trimesh.creation.box(2.0 * np.array(part.half))
        else:
            turned = trimesh.transformations.rotation_matrix(np.pi / 2, (1.0, 0.0, 0.0)) if part.across else None
            mesh = trimesh.creation.cylinder(part.half[0], 2.0 * part.half[1], transform=turned)
        mesh.apply_translation(part.middle)
        mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=(*part.colour, 255))
        meshes.append(mesh)
    whole: Any = trimesh.util.concatenate(meshes)
    return whole


def _painted(parts: Any) -> Any:
    """Return the looks of one body of the B2 as one mesh, in its own frame, m."""
    meshes = []
    for part in parts:
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        colour = (np.array([*part.colour, 1.0]) * 255.0).astype(np.uint8)
        mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.tile(colour, (len(mesh.vertices), 1)))
        meshes.append(mesh)
    return trimesh.util.concatenate(meshes)


def _light(scene: viser.SceneApi) -> None:
    """Light the scene evenly, without shadows: no lamp outside would light the inside of a tunnel."""
    scene.world_axes.visible = False
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(hdri=None)
    scene.add_light_hemisphere("/light/all", sky_color=(255, 250, 242), ground_color=(120, 116, 112), intensity=2.4)
    scene.add_light_directional("/light/side", intensity=1.3, position=(0.4, -0.7, 0.6))


def _seen(points: np.ndarray) -> np.ndarray:
    """Return points or segments for viser, m; none of them become one out of sight."""
    nothing = np.full((1, *points.shape[1:]), -100.0)
    return np.asarray(points if len(points) else nothing, np.float32)


def _about_z(angle: float) -> tuple[float, float, float, float]:
    """Return a rotation about the vertical, rad, as a quaternion, scalar first."""
    return float(np.cos(0.5 * angle)), 0.0, 0.0, float(np.sin(0.5 * angle))


def _status(drawn: Drawn, row: int) -> str:
    station = float(drawn.trace.state.station[row])
    words = [f"{row * drawn.trace.period:.1f} s", f"station {station:.1f} m"]
    words.append(f"error of odometry {drawn.odometer_error[row]:+.2f} m")
    if np.isfinite(drawn.estimate[row, 0]):
        words.append(f"of estimate {drawn.estimate[row, 0] - station:+.2f} m")
    return ", ".join(words)


def _panel(drawn: Drawn, facts: dict[str, str]) -> str:
    """Return the panel beside the scene as HTML: facts, outcome, legend and chart."""
    trace = drawn.trace
    lines = [html.escape(f"{name}: {words}") for name, words in facts.items()]
    lines.append(
        f"<b>{trace.ended.split(' after')[0]}</b> after {trace.time[-1]:.1f} s, {drawn.truth.shape[0] - 1} steps"
    )
    names = [("truth", TRUTH), ("odometry", ODOMETRY), ("LiDAR", _HIT)]
    names += [("estimate ± 2 sd", ESTIMATE)] * bool(np.isfinite(drawn.estimate[1:, 0]).any())
    names += [("goal", _GOAL)] * bool(np.isfinite(drawn.goal))
    lines.append(" · ".join(f"<b style='color:{rgb(colour)}'>{name}</b>" for name, colour in names))
    return f"<div style='{_PANEL}'>{'<br>'.join(lines)}{error_chart(drawn)}</div>"
