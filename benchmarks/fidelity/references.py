"""References to judge by: a held-out recording with its beams without return, and the generator's truth."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from benchmarks.fidelity.files import FidelityError, file_hash
from scene.poses.trajectory import load_tum
from scene.reading.recording import Recording
from scene.reading.rosbag import POINTCLOUD2_TYPE, cloud_records
from scene.reading.source import stack_points
from scene.reading.times import Scan, make_scan, time_field

SILENT_RANGE = 1e6  # m: where the point of a beam without return is put, in its direction
_FEWEST_RETURNS = 8  # returns of a ring or column that tell its direction


def is_organised(recording: Recording) -> bool:
    """Return True where the recording holds sweeps as rings by columns, with times for lost beams (Ouster).

    A Livox message keeps a place for them too, but nothing in it gives their direction.
    """
    for message in _messages(recording):
        whole = message.height * message.width * message.point_step == len(message.data)
        timed = time_field(field.name for field in message.fields)[0] is not None
        return bool(whole and message.height > 1 and message.width > 1 and timed)
    return False


def organised_scans(recording: Recording) -> Iterator[Scan]:
    """Yields sweeps in which a beam without return is a point `SILENT_RANGE` metres away in its direction.

    Raises:
        ValueError: A message is no organised sweep.
    """
    for message in _messages(recording):
        points, times, name = _read_fields(message)
        back = np.isfinite(points).all(axis=2) & (points != 0).any(axis=2)
        look, known = beam_directions(points, back)
        filled = np.where((known & ~back)[..., None], SILENT_RANGE * look, points)
        filled[~known & ~back] = 0.0
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        yield recording.convention.apply(make_scan(stamp, filled.reshape(-1, 3), times.ravel(), name))[0]


def beam_directions(
    points: Float[np.ndarray, "rings columns 3"], back: Bool[np.ndarray, "rings columns"]
) -> tuple[Float[np.ndarray, "rings columns 3"], Bool[np.ndarray, "rings columns"]]:
    """Return the direction of each beam of a sweep, and where it is known, from the returns of its ring.

    A ring is a cone about the sensor's axis of rotation; its azimuth is that of the column plus a constant. Both
    constants are medians over the ring's own returns, so nothing of the maker's calibration is needed.
    """
    columns = points.shape[1]
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    elevation = np.arctan2(points[..., 2], np.hypot(points[..., 0], points[..., 1]))
    turn = 2.0 * np.pi * np.arange(columns) / columns
    # The sweep turns one way or the other; the right one leaves the smaller spread.
    residuals = [_wrap(azimuth - sense * turn) for sense in (1.0, -1.0)]
    sense, residual = max(
        zip((1.0, -1.0), residuals, strict=True), key=lambda pair: float(np.abs(np.exp(1j * pair[1][back]).sum()))
    )
    look, known = np.zeros_like(points, dtype=float), np.zeros(back.shape, bool)
    for ring in np.flatnonzero(back.sum(axis=1) >= _FEWEST_RETURNS):
        returned = back[ring]
        middle = np.angle(np.exp(1j * residual[ring, returned]).sum())
        offset = middle + np.median(_wrap(residual[ring, returned] - middle))
        level = np.median(elevation[ring, returned])
        heading = sense * turn + offset
        look[ring] = np.stack(
            [np.cos(level) * np.cos(heading), np.cos(level) * np.sin(heading), np.full(columns, np.sin(level))], axis=1
        )
        known[ring] = True
    return look, known


def _messages(recording: Recording) -> Iterator[Any]:
    asked = (recording.topic, POINTCLOUD2_TYPE)
    known = recording.reader.connections if recording.reader else ()
    connections = [c for c in known if (c.topic, c.msgtype) == asked]
    if not connections:
        return
    for _, _, raw in recording.reader.messages(connections=connections):
        yield recording.deserialize(bytes(raw), POINTCLOUD2_TYPE)


def _read_fields(message: Any) -> tuple[Float[np.ndarray, "rings columns 3"], Int[np.ndarray, "rings columns"], str]:
    if message.height * message.width * message.point_step != len(message.data):
        raise ValueError(f"a sweep of {message.height} x {message.width} points in {len(message.data)} bytes")
    rows = cloud_records(message)
    name, _ = time_field(rows.dtype.names or ())
    if name is None:
        raise ValueError("a sweep whose points have no times")
    shape = (message.height, message.width)
    return stack_points(rows)[:, :3].reshape(*shape, 3), rows[name].reshape(shape), name


def _wrap(angle: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


# Held-out recording and truth.

TRUTH_SCHEMA = "subterra.truth/1"
PARTS = ("lining", "joint", "pocket", "nail", "floor", "sleeper", "rail", "fastening")  # of `truth.ply`, by number


@dataclass(frozen=True)
class Hold:
    """Beams of a recording that the builder never opened, tunnel frame."""

    time: Float[np.ndarray, " n"]  # Time of each beam, s, `(n,)`
    scan: Int[np.ndarray, " n"]  # Number of its scan, `(n,)`; beams are in the order of scans
    origin: Float[np.ndarray, "n 3"]  # Position of the sensor, m, `(n, 3)`
    direction: Float[np.ndarray, "n 3"]  # Unit vectors, `(n, 3)`
    range: Float[np.ndarray, " n"]  # Distance to the return, m; `inf` where none came back, `(n,)`
    sensor: str  # Name of the sensor
    sigma: float  # Standard deviation of its range noise by the sensor's data sheet, m
    range_max: float  # Reach of the sensor, m
    hash: str  # SHA-256 of the recording
    knows_missing: bool = False  # True where beams without a return are among the beams
    # Results computed from this reference alone
    cache: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def returned(self) -> Bool[np.ndarray, " n"]:
        """True for beams that came back, `(n,)`."""
        return np.isfinite(self.range)

    @property
    def points(self) -> Float[np.ndarray, "k 3"]:
        """Points of the returns, m, `(k, 3)`."""
        kept = self.returned
        return self.origin[kept] + self.range[kept, None] * self.direction[kept]


@dataclass(frozen=True)
class Truth:
    """Exact truth of a simulated survey, tunnel frame."""

    station: Float[np.ndarray, " n"]  # m, `(n,)`
    position: Float[np.ndarray, "n 3"]  # Middle of width and height, m, `(n, 3)`
    tangent: Float[np.ndarray, "n 3"]  # Unit vectors, `(n, 3)`
    width: Float[np.ndarray, " n"]  # Largest inner width, m, `(n,)`
    height: Float[np.ndarray, " n"]  # Floor to crown, m, `(n,)`
    surface: trimesh.Trimesh  # The true surface: lining with pockets, floor, sleepers, rails, fastenings
    part: Int[np.ndarray, " f"]  # Index into `parts` of each face of `surface`, `(f,)`
    parts: tuple[str, ...]  # Names of the parts
    furniture: dict[str, Any]  # `rings`, `pockets`, `nails`, `sleepers`, `rails` of `truth.json`, in the survey frame
    origin: Float[np.ndarray, "3"]  # Point subtracted from the survey frame, m, `(3,)`
    # Results computed from this reference alone
    cache: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    def faces(self, *names: str) -> trimesh.Trimesh:
        """Return some parts of the true surface, with all of its vertices."""
        kept = np.isin(self.part, [self.parts.index(name) for name in names if name in self.parts])
        return trimesh.Trimesh(self.surface.vertices, self.surface.faces[kept], process=False)


@dataclass(frozen=True)
class HoldConfig:
    """Part of a held-out recording to score."""

    scan_spacing: float = 1.0  # Distance that the sensor moves between two scans kept, m.
    beams_per_scan: int = 6000  # Beams kept of a scan at most, evenly spaced in time.
    sigma: float = 0.02  # Range noise by the data sheet, m.
    range_max: float = 100.0  # Reach, m.


def load_hold(recording: Path, trajectory: Path, origin: Float[np.ndarray, "3"], config: HoldConfig) -> Hold:
    """Reads a held-out recording with its poses.

    Args:
        recording: Any recording that `scene` reads.
        trajectory: Poses of its LiDAR in the frame of the scene's input, TUM.
        origin: Origin of the tunnel frame in that frame, m.
        config: Part of the recording to keep.

    Raises:
        FidelityError: Nothing of it has a pose.
        RecordingError: It cannot be read.
    """
    poses = load_tum(trajectory)
    kept: list[tuple[np.ndarray, ...]] = []
    last = None
    with Recording(recording) as opened:
        knows_missing = is_organised(opened)
        for number, scan in enumerate(organised_scans(opened) if knows_missing else opened.scans()):
            times = scan.stamp + scan.times
            if not len(times) or not poses.covers(times.min(), times.max()):
                continue
            here = poses.at(np.array([scan.stamp]))[0][0]
            if last is not None and np.linalg.norm(here - last) < config.scan_spacing:
                continue
            last = here
            pick = np.linspace(0, len(times) - 1, min(len(times), config.beams_per_scan)).astype(int)
            position, rotation = poses.at(times[pick])
            reach = np.linalg.norm(scan.points[pick], axis=1)
            direction = rotation.apply(scan.points[pick] / np.maximum(reach, 1e-9)[:, None])
            kept.append((times[pick], np.full(len(pick), number), position - origin, direction, reach))
        topic = opened.topic
    if not kept:
        raise FidelityError(f"{recording}: no scan lies within the times of {trajectory}")
    time, scan_number, at, direction, reach = (np.concatenate(column) for column in zip(*kept, strict=True))
    good = reach > 1e-3
    reach = np.where(reach > 0.5 * SILENT_RANGE, np.inf, reach)
    return Hold(
        time[good], scan_number[good], at[good], direction[good], reach[good],
        sensor=topic, sigma=config.sigma, range_max=config.range_max, hash=file_hash(recording),
        knows_missing=knows_missing,
    )  # fmt: skip


def load_truth(folder: Path, origin: Float[np.ndarray, "3"]) -> Truth:
    """Reads `truth.json` and `truth.ply` of a simulated survey.

    Raises:
        FidelityError: Missing, or of another schema.
    """
    path = folder / "truth.json"
    if not path.exists() or not (folder / "truth.ply").exists():
        raise FidelityError(f"{folder}: holds no truth.json with its truth.ply")
    try:
        data = json.loads(path.read_text())
        if data.get("schema") != TRUTH_SCHEMA:
            raise ValueError(f"schema is {data.get('schema')}, not {TRUTH_SCHEMA}")
        surface, part = _read_parts(folder / "truth.ply", origin)
        names = ("station", "position", "tangent", "width", "height")
        station, position, tangent, width, height = columns = [np.asarray(data[name], float) for name in names]
        if len({len(column) for column in columns}) > 1 or not all(np.isfinite(column).all() for column in columns):
            raise ValueError("its columns differ in length or are not finite")
    except Exception as error:  # JSON, PLY and numpy raise their own
        raise FidelityError(f"{path}: cannot be read with its truth.ply ({error})") from error
    furniture = {name: data[name] for name in ("rings", "pockets", "nails", "sleepers", "rails") if name in data}
    return Truth(station, position - origin, tangent, width, height, surface, part, PARTS, furniture, origin)


def _read_parts(path: Path, origin: Float[np.ndarray, "3"]) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"]]:
    from plyfile import PlyData

    ply = PlyData.read(path, known_list_len={"face": {"vertex_indices": 3}})  # else read face by face, 50 s for 351 m
    vertex, face = ply["vertex"], ply["face"]
    points = np.column_stack([vertex[axis] for axis in "xyz"]).astype(float) - origin
    faces = np.asarray(face["vertex_indices"]).astype(np.int64)
    return trimesh.Trimesh(points, faces, process=False), np.asarray(face["part"]).astype(int)
