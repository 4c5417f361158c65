"""The paper's figures: recording beside bore (1), occupancy (3), learning curves (4).

`python -m benchmarks.draw paper --survey build/survey --scene build/tunnel --out out/figures`; `make figures` makes
survey, scene and runs as well.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.ndimage import minimum_filter1d

from benchmarks.command import BenchmarkError, run_main
from benchmarks.draw.scene import Picture, Pose, picture
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.surface import surface_caster
from benchmarks.fidelity.references import HoldConfig, load_hold
from benchmarks.fidelity.report.figures import Sheet, draw_mismatch, draw_projections
from benchmarks.results import write_file
from scene.poses.trajectory import Trajectory, load_tum
from scene.reading.recording import Recording
from scene.reading.times import Scan
from subterra_jax.host.files import replace_file, require_folder
from train.curve import write_curve

SURVEY_FILES = ("survey.bag", "groundtruth.tum", "survey_os1.bag", "groundtruth_os1.tum")
SCENE_FILES = ("scene.xml", "bore.npz", "cloud.ply", "manifest.json")
_PAGE = 7.16  # in; width of two columns, IEEE's guide for authors
_STYLE: dict[Any, Any] = {
    "font.family": "STIXGeneral",  # as narrow as Times, and comes with Matplotlib
    "mathtext.fontset": "stix",
    "font.size": 8.0, "axes.labelsize": 8.0, "axes.titlesize": 8.0, "legend.fontsize": 7.0,
    "xtick.labelsize": 7.0, "ytick.labelsize": 7.0, "axes.linewidth": 0.6,
    "pdf.fonttype": 42,  # TrueType: text stays text, and publishers take it
}  # fmt: skip
_FRAME_SHARE, _FRAME_RADIUS = 0.3, 8.0  # of the bore's length where the frame is taken; m around it
_DURATION = 1.5  # s of a frame: enough for the Avia's pattern to close most of its gaps
_FOV = np.deg2rad(58.0)  # at 4:3 inside the Avia's 70 by 77 degrees
_NEAREST, _RETURN = 0.3, 0.016  # m; nearer returns are not drawn; radius of a drawn one, never less than a pixel
_LARGEST = 9  # pixels across a drawn return, at most


@dataclass(frozen=True)
class PaperConfig:
    """Draws the paper's figures as PDF and PNG, with captions and numbers in `figures.json`."""

    survey: Path | None = None  # Folder of a simulated survey with the sensors Avia and OS1, for figures 1 and 3.
    scene: Path | None = None  # Scene folder built from its `survey.bag`; the OS1 is held out.
    runs: Path | None = None  # Folder with run folders `seed-*` of `train`, for figure 4.
    out: Path = Path("out/figures")  # Output folder.


@dataclass(frozen=True)
class Stretch:
    """A piece of the bore where a frame may be taken."""

    position: Float[np.ndarray, "3"]  # Its middle in the tunnel frame, m
    axis: Float[np.ndarray, "3"]  # Unit vector along the bore
    radius: float  # Largest distance of a frame from `position`, m


@dataclass(frozen=True)
class Frame:
    """Returns of a short time, in the tunnel frame."""

    position: Float[np.ndarray, "3"]  # LiDAR position in the middle of that time, m
    origin: Float[np.ndarray, "n 3"]  # LiDAR position at each return, m
    points: Float[np.ndarray, "n 3"]  # Returns, m
    topic: str  # Topic of the recording
    duration: float  # Length of the frame, s


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
    sensor, points = [], []
    for scan in taken:
        position, rotation = poses.at(scan.stamp + scan.times)
        sensor.append(position - origin)
        points.append(position - origin + rotation.apply(scan.points))
    here = poses.at(np.array([middle]))[0][0] - origin
    return Frame(here, np.concatenate(sensor), np.concatenate(points), topic, duration)


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


@dataclass(frozen=True)
class Material:
    """A survey and the scene built from its Avia, with the OS1 held out; each part is read on first use."""

    survey: Path
    scene: Path

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Manifest of the scene."""
        return dict(json.loads((self.scene / "manifest.json").read_text()))

    @cached_property
    def case(self) -> Case:
        """Scene with the held-out OS1."""
        candidate, (bag, poses) = load_candidate(self.scene), (self.survey / name for name in SURVEY_FILES[2:])
        return Case(candidate, load_hold(bag, poses, candidate.origin, HoldConfig(scan_spacing=0.5, sigma=0.03)))

    @cached_property
    def row(self) -> int:
        """Index of the bore's section where the frame is taken."""
        return round(_FRAME_SHARE * (len(self.case.candidate.bore.station) - 1))

    @cached_property
    def frame(self) -> Frame:
        """Frame of the recording that the builder read."""
        bore = self.case.candidate.bore
        stretch = Stretch(bore.position[self.row], bore.tangent[self.row], _FRAME_RADIUS)
        recording, poses = (self.survey / name for name in SURVEY_FILES[:2])
        return load_frame(recording, poses, self.case.candidate.origin, stretch, _DURATION)

    @cached_property
    def pose(self) -> Pose:
        """Camera at the LiDAR, looking along the bore in the LiDAR's direction."""
        frame, bore = self.frame, self.case.candidate.bore
        tangent = bore.tangent[np.argmin(np.linalg.norm(bore.position - frame.position, axis=1))]
        ahead = tangent * np.sign(((frame.points - frame.origin) @ tangent).mean() or 1.0)
        return Pose(frame.position, ahead, float(_FOV), 1400, 1050)

    @cached_property
    def view(self) -> Picture:
        """Scene rendered by MuJoCo from that pose."""
        return picture(self.scene, self.pose)


Drawn = tuple[Figure, str]


def draw_bore_view(material: Material) -> Drawn:
    """Draws figure 1: recorded returns by depth on the left, MuJoCo's picture on the right."""
    frame = material.frame
    figure, (left, right) = plt.subplots(1, 2, figsize=(_PAGE, 2.72), layout="constrained")
    depth = depth_image(material.pose, in_camera(material.pose, frame.points))
    shown = left.imshow(depth, cmap="viridis_r", norm=LogNorm(2.0, 40.0), interpolation="nearest")
    left.set_title(f"(a) recording, {frame.duration:g} s of {frame.topic}")
    right.imshow(material.view)
    right.set_title("(b) reconstructed bore in MuJoCo, same pose")
    for axes in (left, right):
        axes.set(xticks=[], yticks=[])
    bar = figure.colorbar(shown, ax=left, location="left", shrink=0.9, pad=0.02, ticks=(2, 5, 10, 20, 40), extend="max")
    bar.set_label("depth, m")
    bar.ax.minorticks_off()
    bar.ax.set_yticklabels(("2", "5", "10", "20", "40"))
    beam = frame.points - frame.origin
    reach = np.linalg.norm(beam, axis=1)
    cast, _ = surface_caster(material.case).first(frame.origin, beam / np.maximum(reach, 1e-9)[:, None])
    error = np.abs(cast - reach)[np.isfinite(cast)]
    return figure, (
        f"{frame.duration:g} s of the recording, coloured by depth (a), and the MuJoCo scene from the same pose (b). "
        f"Along the recorded beams the scene is {100 * np.median(error):.1f} cm from the returns (median; "
        f"{100 * np.mean(error < 0.10):.1f} % within 10 cm)."
    )


def depth_image(pose: Pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "height width"]:
    """Returns the depth of the nearest return in each pixel, m; NaN where there is none.

    Args:
        pose: Camera.
        points: Returns to the right, up and ahead of it, m; each is drawn at its size for its distance.
    """
    image = np.full((pose.height, pose.width), np.inf)
    column = np.round(0.5 * pose.width + pose.focal * points[:, 0] / points[:, 2]).astype(int)
    row = np.round(0.5 * pose.height - pose.focal * points[:, 1] / points[:, 2]).astype(int)
    reach = np.clip(pose.focal * _RETURN / points[:, 2], 1, _LARGEST // 2).astype(int)
    for down in range(-(_LARGEST // 2), _LARGEST // 2 + 1):
        for across in range(-(_LARGEST // 2), _LARGEST // 2 + 1):
            covers = reach >= max(abs(down), abs(across))
            y, x = row[covers] + down, column[covers] + across
            inside = (y >= 0) & (y < pose.height) & (x >= 0) & (x < pose.width)
            np.minimum.at(image, (y[inside], x[inside]), points[covers][inside, 2])
    return np.where(np.isfinite(image), image, np.nan)


def in_camera(pose: Pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """Returns the points inside a camera's picture: right, up and ahead of it, m."""
    local = (points - pose.position) @ pose.axes.T
    local = local[local[:, 2] > _NEAREST]
    half = 0.5 * np.array([pose.width, pose.height]) / pose.focal
    return local[(np.abs(local[:, :2] / local[:, 2:]) <= half).all(axis=1)]


def _drawings(material: Material) -> dict[str, Callable[[], Drawn | None]]:
    """Returns what draws figures 1 and 3 by name; the third is that of a fidelity report."""
    report = {"seed": 0, "split": {"hold": {"file": SURVEY_FILES[2]}, "rule": "by sensor"}}
    sheet = Sheet(material.case, report)
    return {
        "fig1": lambda: draw_bore_view(material),
        "fig3a": lambda: draw_projections(sheet),
        "fig3b": lambda: draw_mismatch(sheet),
    }


def run(config: PaperConfig) -> None:
    """Draws the figures that the inputs allow.

    Raises:
        SubterraError: An input is missing or broken, or the folder cannot be written.
    """
    if config.runs is None and (config.survey is None or config.scene is None):
        raise BenchmarkError("figures 1 and 3 need --survey and --scene, figure 4 needs --runs")
    for folder, files in ((config.survey, SURVEY_FILES), (config.scene, SCENE_FILES)):
        missing = [folder / file for file in files if not (folder / file).exists()] if folder is not None else []
        if missing:
            raise BenchmarkError(f"{missing[0]}: no such file")
    runs = [] if config.runs is None else sorted(config.runs.glob("seed-*"), key=lambda run: (len(run.name), run.name))
    if config.runs is not None and not runs:
        raise BenchmarkError(f"{config.runs}: holds no run folders seed-0, seed-1, ... of train")
    require_folder(config.out)
    captions = {}
    if config.survey is not None and config.scene is not None:
        material = Material(config.survey, config.scene)
        provenance = f"Survey {config.survey.name}, {material.manifest.get('input_provenance')}."
        with plt.rc_context(_STYLE):
            for name, draw in _drawings(material).items():
                if (drawn := draw()) is not None:
                    captions[name] = f"{drawn[1]} {provenance}"
                    _save(drawn[0], config.out / name)
        write_file(config.out / "figures.json", (json.dumps(captions, indent=1) + "\n").encode())
    if runs:
        config.out.mkdir(parents=True, exist_ok=True)
        write_curve(runs, config.out / "fig4.png")
        print(config.out / "fig4.png")


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    for kind in ("pdf", "png"):
        with replace_file(path.with_suffix(f".{kind}")) as fresh:
            figure.savefig(fresh, dpi=300, format=kind, metadata={"CreationDate": None} if kind == "pdf" else {})
    plt.close(figure)
    print(path.with_suffix(".pdf"))


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("draw paper", PaperConfig, run, description=__doc__, words=words)
