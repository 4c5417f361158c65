"""Trackers of the station alone on the arena's recordings: the ring filter without a map, the particle filter with one.

Both read the odometer and a slice of the cloud at the height of the lowest row of pockets, as planar scans of `N_BEAMS`
ranges. Their poses lie on the tunnel's axis and look where the odometer looks. The ring filter is told the pitch of the
rings, whether the walls have any or not. The particle filter is told the walls, which are drawn again from the settings
beside the truth.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Float
from rosbags.highlevel import AnyReader
from scipy.ndimage import gaussian_filter1d

from benchmarks.slam.arena.record import Scene
from benchmarks.slam.arena.sets import redraw
from benchmarks.slam.arena.wheels import SCALE, SCALE_PIECE, SCALE_SIGMA
from benchmarks.slam.reading import CALIBRATION, Poses, read_samples
from scene.poses.trajectory import Trajectory, load_tum
from scene.survey.cast import Caster
from scene.survey.furniture import DESIGN
from subterra_jax.baselines import cloud as particles
from subterra_jax.baselines.rings import filter as rings
from subterra_jax.baselines.scanmodel import ScanModel, TunnelPose, fit, fit_roughly
from subterra_jax.baselines.wallmap import WallMap
from subterra_jax.parts.wander import WanderParams

N_BEAMS = 40
_RANGE_MAX = 30.0  # m, reported by a beam without an echo
_HALF = np.deg2rad(0.7)  # rad to either side of a beam, within which the median echo counts
SLICE, _SLICE_HALF = 0.76, 0.09  # m over the floor, and to either side: the lowest row of pockets of `scene.survey`
_LEAST_BEAMS = 5  # on each side in the first sweep; fewer are no scan of both walls
_CELL, _BLUR = 0.02, 0.03  # m, as in `wallmap.wall_map`
_N_PARTICLES, _SEED = 256, 0


class Step(NamedTuple):
    """Input of a tracker at a sweep: ranges, m, and the odometer's distance since the last one, m."""

    ranges: Float[np.ndarray, "n_beams"]
    distance: float


Tracker = Callable[[Step], float]  # advances by a sweep; returns the station less that of the start, m


def run_tracker(name: str, recording: Path) -> Poses:
    """Runs a tracker on a recording; compiling is not part of the time it takes.

    Raises:
        ValueError: The LiDAR does not see both walls.
    """
    odometer = load_tum(recording / "recording" / "odometry.tum")
    tracker, spare = (_make(name, recording) for _ in range(2))
    times: list[float] = []
    stations, seconds = [], 0.0
    for now, step in read_steps(recording, odometer):
        if not times:
            spare(step)  # compiles
        started = time.perf_counter()
        stations.append(tracker(step))
        seconds += time.perf_counter() - started
        times.append(now)
    _, turns = odometer.at(np.array(times))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3], poses[:, :3, :3] = stations, turns.as_matrix()
    return np.array(times), poses, seconds


def read_steps(recording: Path, odometer: Trajectory) -> Iterator[tuple[float, Step]]:
    """Yields the middle of each sweep, s, and its step; scans are turned back by the odometer's heading.

    Raises:
        ValueError: The first sweep does not show both walls.
    """
    before, height = None, read_height(recording)
    for stamp, points in read_samples(recording):
        if isinstance(points, tuple):
            continue
        now = 1e-9 * stamp + 0.05
        ends, turns = odometer.at(np.clip([now - 0.05, now, now + 0.05], odometer.times[0], odometer.times[-1]))
        velocity = turns[1].inv().apply(ends[2] - ends[0]) / 0.1
        ranges = slice_cloud(points, height, velocity, float(turns[1].as_euler("ZYX")[0]))
        if before is None and not _sees_walls(ranges):
            raise ValueError("needs a LiDAR that sees both walls")
        yield now, Step(ranges, 0.0 if before is None else float(np.linalg.norm(ends[1] - before)))
        before = ends[1]


def read_height(recording: Path) -> float:
    """Returns the height of the LiDAR over the floor, m, as `/tf_static` says."""
    frame = yaml.safe_load((recording / CALIBRATION).read_text())["lidar"]["frame"]
    with AnyReader([recording / "recording"]) as reader:
        wanted = [one for one in reader.connections if one.topic == "/tf_static"]
        connection, _, raw = next(reader.messages(wanted))
        message: Any = reader.deserialize(raw, connection.msgtype)
    return next(float(one.transform.translation.z) for one in message.transforms if one.child_frame_id == frame)


def slice_cloud(
    points: np.ndarray, height: float, velocity: Float[np.ndarray, "3"], heading: float
) -> Float[np.ndarray, "n_beams"]:
    """Returns the points at the height of the pockets as a planar scan, m, without the motion within the sweep.

    Args:
        points: Array of `sweep_points.POINT`.
        height: Height of the LiDAR over the floor, m.
        velocity: Velocity in the LiDAR's frame, m/s.
        heading: Heading of the LiDAR; beam 0 looks along heading 0, the others follow counter-clockwise, rad.

    Returns:
        Ranges; a beam without a point at that height reports 30 m.
    """
    xyz = np.column_stack([points["x"], points["y"], points["z"]]).astype(np.float64)
    chosen = (np.abs(xyz).sum(axis=1) > 0.0) & (np.abs(height + xyz[:, 2] - SLICE) < _SLICE_HALF)
    xyz = xyz[chosen] + velocity * (1e-9 * points["t"][chosen] - 0.05)[:, None]
    bearing, away = np.arctan2(xyz[:, 1], xyz[:, 0]) + heading, np.hypot(xyz[:, 0], xyz[:, 1])
    beam = np.rint(bearing * N_BEAMS / (2.0 * np.pi)).astype(int)
    near = np.abs(bearing - beam * 2.0 * np.pi / N_BEAMS) < _HALF
    ranges = np.full(N_BEAMS, _RANGE_MAX)
    for k in range(N_BEAMS):
        if (of_beam := near & (beam % N_BEAMS == k)).any():
            ranges[k] = min(np.median(away[of_beam]), _RANGE_MAX)
    return ranges


def _sees_walls(ranges: Float[np.ndarray, "n_beams"]) -> bool:
    """Tells whether enough beams to either side have an echo."""
    seen = ranges[1:] < _RANGE_MAX
    return bool(min(np.sum(seen[: N_BEAMS // 2 - 1]), np.sum(seen[N_BEAMS // 2 :])) >= _LEAST_BEAMS)


def _make(name: str, recording: Path) -> Tracker:
    return track_rings() if name == "ring-filter" else track_map(redraw(recording.parent.parent, recording.name))


def track_rings() -> Tracker:
    """Begins the ring filter of `subterra_jax.baselines`, without a pattern, on dry rail."""
    track = rings.start(N_BEAMS, wet=False)

    def advance(step: Step) -> float:
        nonlocal track
        ranges, pitch = jnp.asarray(step.ranges, jnp.float32), jnp.float32(DESIGN.ring_width)
        track = _count_rings(track, ranges, jnp.float32(step.distance), jnp.ones(()), pitch, jnp.zeros(()))
        return float(track.estimate.station)

    return advance


def track_map(scene: Scene) -> Tracker:
    """Begins the particle filter of `subterra_jax.baselines` at the start, on the mapped walls of a scene."""
    walls, begin = map_walls(scene), scene.drive.begin
    cloud: particles.Cloud | None = None
    count = itertools.count()

    def advance(step: Step) -> float:
        nonlocal cloud
        key = jax.random.fold_in(jax.random.key(_SEED), next(count))
        ranges = jnp.asarray(step.ranges, jnp.float32)
        if cloud is None:
            cloud = _spread_cloud(key, walls, begin, ranges)
        station, cloud = _move_cloud(key, cloud, walls, ranges, step.distance)
        return float(station) - begin

    return advance


_count_rings = jax.jit(rings.advance)
_MOTION = particles.CloudParams(SCALE, WanderParams(SCALE_SIGMA, SCALE_PIECE))


@jax.jit
def _spread_cloud(key: Any, walls: WallMap, station: Any, ranges: Any) -> particles.Cloud:
    """Returns particles at a station, m, their offsets and headings adjusted to the scan."""
    pose = TunnelPose(jnp.full(_N_PARTICLES, station), *jnp.zeros((2, _N_PARTICLES)))
    pose = fit_roughly(walls, pose, ranges, jnp.float32(_RANGE_MAX), ScanModel())
    return particles.new_cloud(key, pose, _MOTION)


@jax.jit
def _move_cloud(key: Any, cloud: particles.Cloud, walls: WallMap, ranges: Any, distance: Any) -> Any:
    """Moves, weighs, summarises and resamples, as `ParticleLocaliser.update`; the scans come turned already."""
    move_key, draw_key = jax.random.split(jax.random.fold_in(key, 1))
    cloud = particles.move(move_key, cloud, walls, distance, jnp.zeros(()), _MOTION)
    likely, pose = fit(walls, cloud.pose, ranges, jnp.float32(_RANGE_MAX), ScanModel())
    cloud = particles.reweight(dataclasses.replace(cloud, pose=pose), likely, _MOTION)
    station, _, _ = particles.summarise(cloud, _MOTION)
    return station, particles.resample(draw_key, cloud, _MOTION)


def map_walls(scene: Scene) -> WallMap:
    """Returns the walls of a straight bore at the height of the slice, measured to either side of the axis."""
    bore, length = scene.drive.bore, scene.drive.bore.alignment.length
    station = (np.arange(int(length / _CELL)) + 0.5) * _CELL
    frames, caster = bore.alignment.frames(station), Caster(bore.mesh(), _RANGE_MAX)
    above = SLICE - 0.5 * bore.section.height(station)
    points = frames.point(np.zeros_like(station), above)
    wall = np.empty((2, len(station)))
    for rows in np.split(np.arange(len(station)), range(50, len(station), 50)):  # a metre at a time
        caster.load(float(station[rows[0]]), points[rows[0]])
        for side, sign in enumerate((1.0, -1.0)):
            wall[side, rows] = caster.cast_loaded(points[rows], sign * frames.lateral[rows]).distance
    known = np.isfinite(wall)
    wall = np.stack([np.interp(station, station[ok], row[ok]) for row, ok in zip(wall, known, strict=True)])
    mean = gaussian_filter1d(wall, _BLUR / _CELL, axis=1, mode="nearest")
    middle = wall.mean(axis=1, keepdims=True)
    spread = gaussian_filter1d((wall - middle) ** 2, _BLUR / _CELL, axis=1, mode="nearest") - (mean - middle) ** 2
    zero = jnp.zeros((), jnp.int32)
    return WallMap(
        wall=jnp.asarray(mean, jnp.float32), spread=jnp.asarray(np.maximum(spread, 0.0), jnp.float32),
        bend=jnp.zeros((3, 2)), half_width=jnp.float32(np.median(wall)), cell=jnp.float32(_CELL),
        spacing=jnp.float32(length), first_cell=zero, n_cells=jnp.int32(len(station)), first_node=zero,
        n_nodes=jnp.int32(2),
    )  # fmt: skip
