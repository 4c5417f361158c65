"""The scene in the browser: nodes that are made once, and moved."""

import threading
import time

import numpy as np
import viser

from subterra_jax.viewer.course import Course
from subterra_jax.viewer.frames import Film, Frame
from subterra_jax.viewer.legged import Legged
from subterra_jax.viewer.props import about_z, boxes, gate, light
from subterra_jax.viewer.robot import Carrier, robot_mesh
from subterra_jax.viewer.shapes import Shape

TRUTH, ODOMETRY, ESTIMATE, _HIT = (64, 156, 255), (255, 120, 60), (190, 110, 255), (255, 214, 102)
_LINES_EVERY = 0.09  # s; a browser without a GPU cannot take new lines more often, and drops all of them
_LINES = ("beams", "truth", "odometry", "estimate")
_PARK = np.array([[[0.0, 0.0, -100.0]] * 2])  # where a set of lines that has none is kept


class Stage:
    """Everything that is drawn; any thread may change it.

    Args:
        server: Where it is drawn.
    """

    def __init__(self, server: viser.ViserServer):
        self._server, self._lock = server, threading.RLock()
        self._shapes: dict[str, list[viser.MeshHandle]] = {"lining": [], "track": []}
        self._props: list[viser.SceneNodeHandle] = []
        self._row: tuple[Film, int] | None = None
        self._lines_at = 0.0
        self._made = 0  # tunnels so far: each has names of its own, so that the old one can be shown until it is there
        self.visible = {name: True for name in ("lining", "track", *_LINES)}
        server.scene.world_axes.visible = False
        light(server.scene)
        self._robot: Carrier | Legged | None = None
        self._ghost: viser.MeshHandle | None = None
        colours = {"beams": _HIT, "truth": TRUTH, "odometry": ODOMETRY, "estimate": ESTIMATE}
        self._lines = {
            name: server.scene.add_line_segments(
                f"/{name}", _PARK, colours[name], thickness=0.02 if name == "beams" else 0.07
            )
            for name in _LINES
        }
        self._hits = self._points("/hits", _HIT, 0.1)
        self._particles = self._points("/particles", ESTIMATE, 0.07)

    def _points(self, name: str, colour: tuple[int, int, int], size: float) -> viser.PointCloudHandle:
        return self._server.scene.add_point_cloud(
            name, _PARK[:, 0], colour, point_size=size, point_shape="circle", precision="float32", point_shading="flat"
        )

    def set_tunnel(self, shapes: list[Shape], *, cutaway: bool) -> None:
        """Shows another tunnel, or the same in more detail.

        Args:
            shapes: What is drawn of it.
            cutaway: Draw walls from within only, so that one looks into the tunnel from without.
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
        """Walls from within only, or from both sides."""
        for handle in self._shapes["lining"]:
            handle.side = "front" if cutaway else "double"

    def set_visible(self, name: str, visible: bool) -> None:
        """Shows or hides a part: `lining`, `track`, `beams`, `truth`, `odometry` or `estimate`."""
        self.visible[name] = visible
        for handle in self._shapes.get(name, []):
            handle.visible = visible
        belong: dict[str, list[viser.SceneNodeHandle | None]] = {
            "beams": [self._hits],
            "estimate": [self._particles],
            "odometry": [self._ghost],
        }
        for node in [self._lines.get(name), *belong.get(name, [])]:
            if node is not None:
                node.visible = visible

    def set_episode(self, film: Film, course: Course) -> None:
        """The props of another episode: robots of its size, its goal, its boxes."""
        recording, height = film.recording, course.plan.lidar_height
        with self._lock, self._server.atomic():
            for prop in self._props:
                prop.remove()
            scene = self._server.scene
            mesh = robot_mesh(recording.radius, height)
            walks = recording.pose.shape[1] > 0
            self._robot = Legged(scene) if walks else Carrier(scene, mesh)
            self._ghost = scene.add_mesh_simple(
                "/ghost",
                np.asarray(mesh.vertices, np.float32),
                np.asarray(mesh.faces, np.uint32),
                color=ODOMETRY,
                opacity=0.45,
                cast_shadow=False,
                visible=self.visible["odometry"],
            )
            self._props = [
                *self._robot.nodes,
                self._ghost,
                *gate(self._server.scene, film),
                *boxes(self._server.scene, film),
            ]
            self._row = None

    def show(self, film: Film, frame: Frame, full: bool) -> None:
        """One moment; lines and points, which change only with the rows of the recording, now and then or if `full`."""
        with self._lock, self._server.atomic():
            if self._robot is None or self._ghost is None:
                return
            self._robot.place(frame)
            self._ghost.position, self._ghost.wxyz = frame.odometry, about_z(frame.odometry_heading)
            now = time.monotonic()
            if full or (self._row != (film, frame.row) and now - self._lines_at >= _LINES_EVERY):
                self._row, self._lines_at = (film, frame.row), now
                self._show_row(film, frame)

    def _show_row(self, film: Film, frame: Frame) -> None:
        beams, hit = film.beams(frame.row)
        truth, odometry = film.trails(frame)
        lines = {"beams": beams, "truth": truth, "odometry": odometry, "estimate": film.ellipse(frame.row)}
        for name, segments in lines.items():
            self._lines[name].points = (segments if len(segments) else _PARK).astype(np.float32)
        for cloud, points in ((self._hits, beams[hit, 1]), (self._particles, film.particles(frame.row))):
            cloud.points = (points if len(points) else _PARK[:, 0]).astype(np.float32)
