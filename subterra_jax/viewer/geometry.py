"""Surfaces of a tunnel, and lines and points of an episode, in three dimensions; plain arrays, no drawing library."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from subterra_jax.lidar3d.surface import LINING_KINDS, SCENES, ScenePart, join_surfaces, read_mesh, scene_parts
from subterra_jax.recorder.trace import reckon
from subterra_jax.tunnel.plan import TunnelPlan, Wall
from subterra_jax.viewer.recording import Recording


@dataclasses.dataclass(frozen=True)
class Centreline:
    """A tunnel's centreline and its ground in three dimensions."""

    plan: TunnelPlan  # the tunnel

    def ground(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the height of the ground, m; level beyond the mouths."""
        return np.interp(station, self.plan.station, self.plan.elevation)

    def points_at(self, station: Float[np.ndarray, "n"], lateral: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Return points on the ground, m, `lateral` metres left of the centreline; straight on beyond the mouths."""
        centre, tangent = self.axis_at(station)
        offset = lateral[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        return np.column_stack([centre + offset, self.ground(station)])

    def axis_at(self, station: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Return centre (m) and unit tangent in plan."""
        plan = self.plan
        centre, tangent = (
            np.stack([np.interp(station, plan.station, values[:, i]) for i in range(2)], axis=-1)
            for values in (plan.centre, plan.tangent)
        )
        tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
        beyond = station - np.clip(station, 0.0, plan.length)
        return centre + beyond[:, None] * tangent, tangent

    def lift(
        self, points: Float[np.ndarray, "n 2"], station: Float[np.ndarray, "n"], above: float
    ) -> Float[np.ndarray, "n 3"]:
        """Add the height `above` the ground to plan positions at known stations, m."""
        return np.column_stack([points, self.ground(station) + above])


_TRAIL_POINTS = 500  # of a whole trail
_ELLIPSE_POINTS = 48
SIGMAS = 2.0  # half axes of the ellipse, in standard deviations
_SLIM = 0.35  # m, half width of an ellipse without an estimate across the tunnel
ON_GROUND = 0.06  # m above the ground, of lines on the ground


@dataclasses.dataclass(frozen=True)
class Moment:
    """One moment of an episode.

    Attributes:
        row: Last row of the recording at or before it.
        position: True position on the ground, m.
        heading: True heading, rad.
        odometry: Dead-reckoned position on the ground, m.
        odometry_heading: Dead-reckoned heading, rad.
        trunk: Height of a walking robot's trunk, tunnel frame, m.
        pose: Orientation w, x, y, z and joints (rad) of a walking robot; empty for a wheeled one.
    """

    row: int
    position: Float[np.ndarray, "3"]
    heading: float
    odometry: Float[np.ndarray, "3"]
    odometry_heading: float
    trunk: float
    pose: Float[np.ndarray, "k"]


class EpisodeGeometry:
    """Lines and points of an episode in three dimensions.

    Args:
        recording: The episode.
        centreline: Its tunnel.
        finished: Whether the episode is over.
    """

    def __init__(self, recording: Recording, centreline: Centreline, *, finished: bool = True):
        self.recording, self.centreline, self.finished = recording, centreline, finished
        begun = recording.position[0].astype(np.float64), float(recording.heading[0])
        reckoned, self._reckoned_heading = reckon(recording.odometry, *begun)
        self._truth = centreline.lift(recording.position, recording.station, 0.0)
        self._reckoned = centreline.lift(reckoned, recording.station, 0.0)
        self._way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self._truth, axis=0), axis=1)))
        self._heading = np.unwrap(recording.heading.astype(np.float64))

    def __len__(self) -> int:
        return len(self.recording)

    def moment(self, at: float) -> Moment:
        """Return the moment `at` rows after the start, interpolated between rows and clipped to the episode."""
        at = float(np.clip(at, 0.0, len(self) - 1))
        row = int(at)
        after, share = min(row + 1, len(self) - 1), at - row

        def between(values: np.ndarray) -> np.ndarray:
            return (1.0 - share) * values[row] + share * values[after]

        return Moment(
            row,
            between(self._truth),
            float(between(self._heading)),
            between(self._reckoned),
            float(between(self._reckoned_heading)),
            float(between(self.recording.trunk)),
            self._pose(row, after, share),
        )

    def _pose(self, row: int, after: int, share: float) -> Float[np.ndarray, "k"]:
        poses = self.recording.pose[after]
        if not len(poses) or after == row:
            return poses[-1] if len(poses) else np.zeros(0)
        return poses[min(int(share * len(poses)), len(poses) - 1)]

    def way(self, row: int) -> float:
        """Return the distance driven up to a row, m."""
        return float(self._way[row])

    def carried(self, row: int, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return points of the tunnel frame in the robot's frame at a row, m: there they move with the robot."""
        cos, sin = np.cos(self._heading[row]), np.sin(self._heading[row])
        apart = points - self._truth[row]
        x, y = cos * apart[..., 0] + sin * apart[..., 1], cos * apart[..., 1] - sin * apart[..., 0]
        return np.stack([x, y, apart[..., 2]], axis=-1)

    def beams(self, row: int) -> tuple[Float[np.ndarray, "n_beams 2 3"], np.ndarray]:
        """Return the beams of a row from the LiDAR to their ends, in the robot's frame, m, and which hit something.

        In that frame they move with the robot between two rows.
        """
        recording = self.recording
        ranges = recording.ranges[row].astype(np.float64)
        angle = np.arange(len(ranges)) * (2.0 * np.pi / len(ranges))
        lidar = np.array([0.0, 0.0, self.centreline.plan.lidar_height])
        reach = np.where(np.isfinite(ranges), ranges, 0.0)
        along = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        tips = lidar + reach[:, None] * along
        return np.stack([np.broadcast_to(lidar, tips.shape), tips], axis=1), reach < 0.99 * recording.range_max

    def returns(self, row: int) -> Float[np.ndarray, "k 3"]:
        """Return where the beams of a row ended, robot's frame, m; of a LiDAR in three dimensions all that are kept."""
        points = self.recording.points[row].astype(np.float64)
        if points.shape[0]:
            return points[np.isfinite(points).all(axis=1)]
        beams, hit = self.beams(row)
        return beams[hit, 1]

    def trails(self, moment: Moment) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 3"]]:
        """Return the path so far, true and dead-reckoned, as segments, m."""
        stride = max(1, -(-len(self) // _TRAIL_POINTS))
        rows = np.arange(0, moment.row + 1, stride)
        # At different heights, so that they do not flicker where they coincide.
        truth, reckoned = (np.array([0.0, 0.0, share * ON_GROUND]) for share in (1.0, 0.6))
        return _chain(np.vstack([self._truth[rows], moment.position]) + truth), _chain(
            np.vstack([self._reckoned[rows], moment.odometry]) + reckoned
        )

    def ellipse(self, row: int) -> Float[np.ndarray, "n 2 3"]:
        """Return the ellipse of two standard deviations of the agent's estimate, bent along the tunnel, as segments, m.

        Across the tunnel it shows the spread of the particles, or `_SLIM` about the centreline without particles. It is
        empty without an estimate.
        """
        station, sigma = self.recording.estimate[row].astype(np.float64)
        if not (np.isfinite(station) and np.isfinite(sigma)):
            return np.zeros((0, 2, 3))
        middle, across = self._across(row)
        turn = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
        # A straight stretch of an ellipse 100 m long would leave the tunnel in a bend.
        along = np.clip(station + SIGMAS * sigma * np.cos(turn), -5.0, self.centreline.plan.length + 5.0)
        points = self.centreline.points_at(along, middle + across * np.sin(turn))
        return _chain(points + np.array([0.0, 0.0, 1.5 * ON_GROUND]))

    def particles(self, row: int) -> Float[np.ndarray, "k 3"]:
        """Return some of the agent's particles, m."""
        cloud = self.recording.cloud[row].astype(np.float64)
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        points = self.centreline.points_at(cloud[:, 0], cloud[:, 1])
        return points + np.array([0.0, 0.0, 2.0 * ON_GROUND])

    def goal(self) -> Float[np.ndarray, "n 2 3"]:
        """Return a gate across the tunnel at the goal, as segments, m; empty without a goal."""
        if not np.isfinite(self.recording.goal):
            return np.zeros((0, 2, 3))
        station = np.array([self.recording.goal])
        half = float(np.interp(station[0], self.centreline.plan.station, self.centreline.plan.half_width)) - 0.05
        left, right = (self.centreline.points_at(station, np.array([side * half]))[0] for side in (1.0, -1.0))
        up = np.array([0.0, 0.0, 2.2])
        low = np.array([0.0, 0.0, ON_GROUND])
        return _chain(np.array([left + low, left + up, right + up, right + low, left + low]))

    def _across(self, row: int) -> tuple[float, float]:
        """Return middle and half width of the ellipse across the tunnel, m."""
        cloud = self.recording.cloud[row]
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        if not len(cloud):
            return 0.0, _SLIM
        weight = cloud[:, 2] / max(float(cloud[:, 2].sum()), 1e-12)
        mean = float(np.sum(weight * cloud[:, 1]))
        return mean, max(SIGMAS * float(np.sqrt(np.sum(weight * (cloud[:, 1] - mean) ** 2))), 0.15)


def _chain(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 2 3"]:
    return np.stack([points[:-1], points[1:]], axis=1)


Colour = tuple[int, int, int]
_WALL, _FLOOR, _FURNITURE = (176, 172, 164), (112, 108, 102), (96, 120, 134)
WALL_HEIGHT = 2.6  # m, for looks: the file holds one height only


@dataclasses.dataclass(frozen=True)
class Shape:
    """A surface of one colour."""

    name: str  # name of the surface
    vertices: Float[np.ndarray, "v 3"]  # vertices, tunnel frame, m
    faces: Int[np.ndarray, "f 3"]  # rows of `vertices`, counter-clockwise as seen from within the tunnel
    colour: Colour  # Red, green, blue, 0 to 255
    flat: bool = True  # shade each face by its own normal
    group: str = "lining"  # `lining` or `track`; a group is shown and hidden as one


def planar_shapes(plan: TunnelPlan, lining: str) -> list[Shape]:
    """Return both walls, the floor and the furniture of one lining.

    Raises:
        TunnelError: The tunnel does not have the lining.
    """
    centreline, walls = Centreline(plan), plan.lining(lining)
    shapes = [
        _ribbon("left", centreline, walls.left, _WALL, inward=False),
        _ribbon("right", centreline, walls.right, _WALL, inward=True),
        _floor(centreline),
    ]
    return [*shapes, _furniture(centreline, walls.furniture)] if len(walls.furniture) else shapes


def _ribbon(name: str, centreline: Centreline, wall: Wall, colour: Colour, *, inward: bool) -> Shape:
    """Return a wall from the ground up; with `inward` its faces look to the left of growing station."""
    foot = centreline.lift(wall.vertex, wall.station, 0.0)
    n = len(foot)
    low = np.arange(n - 1)
    faces = np.concatenate([np.stack([low, low + 1, low + n], 1), np.stack([low + 1, low + n + 1, low + n], 1)])
    vertices = np.concatenate([foot, foot + np.array([0.0, 0.0, WALL_HEIGHT])])
    return Shape(name, vertices, faces[:, ::-1] if inward else faces, colour)


def _floor(centreline: Centreline) -> Shape:
    plan = centreline.plan
    left, right = (centreline.points_at(plan.station, side * plan.half_width) for side in (1.0, -1.0))
    n = len(left)
    low = np.arange(n - 1)
    faces = np.concatenate([np.stack([low, low + n, low + 1], 1), np.stack([low + 1, low + n, low + n + 1], 1)])
    return Shape("floor", np.concatenate([left, right]), faces, _FLOOR, flat=False)


def _furniture(centreline: Centreline, segments: Float[np.ndarray, "f 4"]) -> Shape:
    """Return posts, brackets and doors as upright panels, visible from both sides."""
    ends = segments.reshape(-1, 2)
    _, nearest = KDTree(centreline.plan.centre).query(segments[:, :2])
    foot = centreline.lift(ends, np.repeat(centreline.plan.station[nearest], 2), 0.0)
    vertices = np.concatenate([foot, foot + np.array([0.0, 0.0, WALL_HEIGHT])])
    first, n = 2 * np.arange(len(segments)), len(foot)
    front = np.concatenate(
        [np.stack([first, first + 1, first + n], 1), np.stack([first + 1, first + n + 1, first + n], 1)]
    )
    return Shape("furniture", vertices, np.concatenate([front, front[:, ::-1]]), _FURNITURE)


_CONCRETE, _BALLAST = (178, 174, 166), (124, 118, 110)
_PAINT: dict[str, Colour] = {
    "concrete": _CONCRETE,
    "floor": _BALLAST,
    "ballast": _BALLAST,
}  # textured in the scene


def lining_shape(folder: Path, lining: str) -> Shape:
    """Return the whole lining as one surface; quick.

    Raises:
        TunnelError: The mesh is missing or damaged.
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
        surface = join_surfaces([part.triangles for part in parts])
        colour = _colour(parts[0])
        shapes.append(Shape(f"{group} {material}", surface.vertices, surface.faces, colour, group != "lining", group))
    return shapes


def _colour(part: ScenePart) -> Colour:
    """Return the material's own colour; for a textured one, about its texture's."""
    if part.material in _PAINT or not part.material:
        return _PAINT.get(part.material, _CONCRETE)
    red, green, blue = (round(255 * float(value)) for value in part.colour[:3])
    return red, green, blue
