"""Inputs of figures 1 to 3: a survey, its scene and one frame of the recording."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import minimum_filter1d

from benchmarks.command import BenchmarkError
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import cast_beams
from benchmarks.fidelity.references import HoldConfig, load_hold
from benchmarks.paper.camera import Pose, picture
from benchmarks.paper.steps import SCENE_FILES, SURVEY_FILES, require
from benchmarks.report import scene_points
from scene.poses.trajectory import Trajectory, load_tum
from scene.reading.recording import Recording
from scene.reading.times import Scan


@dataclass(frozen=True)
class Stretch:
    """A piece of the bore where a frame may be taken.

    Attributes:
        position: Middle of it in the tunnel frame, m, `(3,)`.
        axis: Unit vector along the bore, `(3,)`.
        radius: Largest distance of a frame from `position`, m.
    """

    position: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    radius: float


@dataclass(frozen=True)
class Frame:
    """Returns of a short time, in the tunnel frame.

    Attributes:
        position: LiDAR position in the middle of that time, m, `(3,)`.
        origin: LiDAR position at each return, m, `(n, 3)`.
        points: Returns, m, `(n, 3)`.
        single: Rows of the scan in the middle, one turn or pattern of the sensor.
        topic: Topic of the recording.
        duration: Length of the frame, s.
    """

    position: Float[np.ndarray, "3"]
    origin: Float[np.ndarray, "n 3"]
    points: Float[np.ndarray, "n 3"]
    single: slice
    topic: str
    duration: float


def load_frame(
    recording: Path, trajectory: Path, origin: Float[np.ndarray, "3"], stretch: Stretch, duration: float
) -> Frame:
    """Reads the frame that was taken in a stretch of the bore when the LiDAR looked along it.

    Args:
        recording: A recording that `scene` can read.
        trajectory: Poses of its LiDAR, TUM file.
        origin: Origin of the tunnel frame in the trajectory's frame, m.
        stretch: Piece of the bore.
        duration: Length of the frame, s.

    Raises:
        BenchmarkError: No scan lies within that time.
        RecordingError: The recording or the trajectory cannot be read.
    """
    poses = load_tum(trajectory)
    taken: list[Scan] = []
    with Recording(recording) as opened:
        middle = _best_time(poses, origin, stretch, next(opened.scans()), duration)
        for scan in opened.scans():
            if scan.stamp > middle + 0.5 * duration:
                break
            if scan.stamp >= middle - 0.5 * duration and len(scan.times):
                taken.append(scan)
        topic = opened.topic
    if not taken:
        raise BenchmarkError(
            f"{recording}: no scan within {duration:g} s of {middle:.3f} s, when {trajectory} is there"
        )
    placed = [_place_scan(scan, poses, origin) for scan in taken]
    half = len(taken) // 2
    first = sum(len(scan.times) for scan in taken[:half])
    position = poses.at(np.array([middle]))[0][0] - origin
    sensor, points = (np.concatenate(parts) for parts in zip(*placed, strict=True))
    return Frame(position, sensor, points, slice(first, first + len(taken[half].times)), topic, duration)


def _best_time(
    poses: Trajectory, origin: Float[np.ndarray, "3"], stretch: Stretch, first: Scan, duration: float
) -> float:
    """Returns when the LiDAR, inside the stretch, looked most nearly along the axis, either way, s.

    The mean of its beams is its viewing direction. For a sensor that sees all round it is short, and any time will do.
    """
    gaze = (first.points / np.maximum(np.linalg.norm(first.points, axis=1), 1e-9)[:, None]).mean(axis=0)
    along = np.abs(poses.rotations.apply(gaze) @ stretch.axis)
    width = max(1, round(duration / float(np.median(np.diff(poses.times)))))
    held = minimum_filter1d(along, width, mode="constant")  # over the whole frame, not for a moment
    away = np.linalg.norm(poses.positions - origin - stretch.position, axis=1)
    near = np.flatnonzero(away <= max(stretch.radius, away.min()))
    return float(poses.times[near[np.argmax(held[near])]])


def _place_scan(scan: Scan, poses: Trajectory, origin: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sensor's position at each return and the returns, tunnel frame, m."""
    position, rotation = poses.at(scan.stamp + scan.times)
    return position - origin, position - origin + rotation.apply(scan.points)


_FRAME_SHARE = 0.3  # share of the bore's length where the frame is taken: the bore ahead fills it
_FRAME_RADIUS = 8.0  # m around it where the frame may be taken
_DURATION = 1.5  # s of a frame: enough for the Avia's pattern to close most of its gaps
_FOV = np.deg2rad(58.0)  # at 4:3 inside the Avia's 70 by 77 degrees
_OS1_SIGMA = 0.03  # m, data sheet


@dataclass(frozen=True)
class Material:
    """A survey and the scene built from its Avia, with the OS1 held out; each part is read on first use.

    Attributes:
        survey: Folder with `survey.bag`, `survey_os1.bag` and a trajectory for each.
        scene: Scene folder.
    """

    survey: Path
    scene: Path

    def check(self) -> None:
        """Checks the files; raises `BenchmarkError` naming the first file that is missing."""
        require(self.survey, SURVEY_FILES)
        require(self.scene, SCENE_FILES)

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Manifest of the scene."""
        path = self.scene / "manifest.json"
        try:
            return dict(json.loads(path.read_text()))
        except (OSError, ValueError) as error:
            raise BenchmarkError(f"{path}: is no manifest ({error})") from error

    @property
    def simulated(self) -> bool:
        """True for a simulated survey."""
        return self.manifest.get("input_provenance") == "simulated"

    @cached_property
    def case(self) -> Case:
        """Scene with the held-out OS1."""
        candidate = load_candidate(self.scene)
        config = HoldConfig(scan_spacing=0.5, sigma=_OS1_SIGMA)
        held_out = (self.survey / "survey_os1.bag", self.survey / "groundtruth_os1.tum")
        return Case(candidate, load_hold(*held_out, candidate.origin, config))

    @cached_property
    def residual(self) -> Float[np.ndarray, " k"]:
        """Range in the scene less held-out range of every held-out beam that meets the scene, m."""
        pairs = cast_beams(self.case)
        return pairs.difference[pairs.hit]

    @cached_property
    def row(self) -> int:
        """Index of the bore's section where the frame is taken."""
        return round(_FRAME_SHARE * (len(self.case.candidate.bore.station) - 1))

    @cached_property
    def frame(self) -> Frame:
        """Frame of the recording that the builder read."""
        candidate = self.case.candidate
        stretch = Stretch(candidate.bore.position[self.row], candidate.bore.tangent[self.row], _FRAME_RADIUS)
        return load_frame(
            self.survey / "survey.bag", self.survey / "groundtruth.tum", candidate.origin, stretch, _DURATION
        )

    @cached_property
    def pose(self) -> Pose:
        """Camera at the LiDAR, looking along the bore in the LiDAR's direction."""
        frame, bore = self.frame, self.case.candidate.bore
        tangent = bore.tangent[np.argmin(np.linalg.norm(bore.position - frame.position, axis=1))]
        ahead = tangent * np.sign(((frame.points - frame.origin) @ tangent).mean() or 1.0)
        return Pose(frame.position, ahead, float(_FOV), 1400, 1050)

    @cached_property
    def view(self) -> UInt8[np.ndarray, "height width 3"]:
        """Scene rendered by MuJoCo from that pose."""
        return picture(self.scene / "scene.xml", self.pose)

    @cached_property
    def wall(self) -> UInt8[np.ndarray, "height width 3"]:
        """Lining and foot of the wall at the same place, from closer by."""
        bore = self.case.candidate.bore
        ahead = 0.5 * bore.tangent[self.row] + 0.85 * bore.lateral[self.row]
        return picture(self.scene / "scene.xml", Pose(self.pose.position, ahead / np.linalg.norm(ahead), 1.0, 700, 700))

    @cached_property
    def cloud(self) -> Float[np.ndarray, "p 3"]:
        """Registered cloud, thinned, tunnel frame, m, `(p, 3)`."""
        return scene_points(self.scene)


def read_truth(survey: Path) -> dict[str, Any]:
    """Returns the settings of a simulated survey; empty where its `truth.json` has none."""
    try:
        return dict(json.loads((survey / "truth.json").read_text())["config"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
