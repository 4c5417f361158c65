"""The paper's figures: recording beside bore (1), occupancy (3), learning curves (4).

`python -m benchmarks.draw paper --survey build/survey --scene build/tunnel --out out/figures`; `make figures` makes
survey, scene and runs as well.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from benchmarks.command import BenchmarkError, run_main
from benchmarks.draw.scene import Pose, picture
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.surface import surface_caster
from benchmarks.fidelity.references import HoldConfig, load_hold
from benchmarks.fidelity.report.figures import Sheet, draw_mismatch, draw_projections
from benchmarks.results import write_file
from scene.poses.trajectory import load_tum
from scene.reading.recording import Recording
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
_FRAME_SHARE = 0.3  # of the bore's length where the frame is taken
_DURATION = 1.5  # s of a frame: enough for the Avia's pattern to close most of its gaps
_FOV = np.deg2rad(58.0)  # at 4:3 inside the Avia's 70 by 77 degrees
_NEAREST = 0.3  # m; nearer returns are not drawn


@dataclass(frozen=True)
class PaperConfig:
    """Draws the paper's figures as PDF and PNG, with captions and numbers in `figures.json`."""

    survey: Path | None = None  # Folder of a simulated survey with the sensors Avia and OS1, for figures 1 and 3.
    scene: Path | None = None  # Scene folder built from its `survey.bag`; the OS1 is held out.
    runs: Path | None = None  # Folder with run folders `seed-*` of `train`, for figure 4.
    out: Path = Path("out/figures")  # Output folder.


@dataclass(frozen=True)
class Frame:
    """Returns of `_DURATION`, in the tunnel frame."""

    origin: Float[np.ndarray, "n 3"]  # LiDAR position at each return, m
    points: Float[np.ndarray, "n 3"]  # Returns, m
    topic: str  # Topic of the recording


def load_frame(
    recording: Path, trajectory: Path, origin: Float[np.ndarray, "3"], place: Float[np.ndarray, "3"]
) -> Frame:
    """Reads the frame about the moment at which the LiDAR was nearest to a place.

    Args:
        recording: A recording that `scene` can read.
        trajectory: Poses of its LiDAR, TUM file.
        origin: Origin of the tunnel frame in the trajectory's frame, m.
        place: Place in the tunnel frame, m.

    Raises:
        BenchmarkError: No scan lies within that time.
        RecordingError: The recording or the trajectory cannot be read.
    """
    poses = load_tum(trajectory)
    middle = float(poses.times[np.argmin(np.linalg.norm(poses.positions - origin - place, axis=1))])
    sensor, points = [], []
    with Recording(recording) as opened:
        for scan in opened.scans():
            if abs(scan.stamp - middle) <= 0.5 * _DURATION and len(scan.times):
                position, rotation = poses.at(scan.stamp + scan.times)
                sensor.append(position - origin)
                points.append(position - origin + rotation.apply(scan.points))
        topic = opened.topic
    if not points:
        raise BenchmarkError(f"{recording}: no scan within {_DURATION:g} s of {middle:.3f} s, of {trajectory}")
    return Frame(np.concatenate(sensor), np.concatenate(points), topic)


Drawn = tuple[Figure, str]


def draw_bore_view(case: Case, frame: Frame) -> Drawn:
    """Draws figure 1: recorded returns by depth on the left, MuJoCo's picture from the same pose on the right."""
    beam, bore = frame.points - frame.origin, case.candidate.bore
    here = frame.origin[len(frame.origin) // 2]
    tangent = bore.tangent[np.argmin(np.linalg.norm(bore.position - here, axis=1))]
    pose = Pose(here, tangent * np.sign((beam @ tangent).mean() or 1.0), float(_FOV), 1400, 1050)
    figure, (left, right) = plt.subplots(1, 2, figsize=(_PAGE, 2.72), layout="constrained")
    across, down, depth = in_picture(pose, frame.points)
    far = np.argsort(-depth)  # the nearer return is drawn last
    shown = left.scatter(across[far], down[far], c=depth[far], s=np.clip(4.0 / depth[far], 0.05, 2.0), lw=0.0,
                         cmap="viridis_r", norm=LogNorm(2.0, 40.0), rasterized=True)  # fmt: skip
    left.set(xlim=(0, pose.width), ylim=(pose.height, 0), aspect="equal")
    left.set_title(f"(a) recording, {_DURATION:g} s of {frame.topic}")
    right.imshow(picture(case.candidate.folder, pose))
    right.set_title("(b) reconstructed bore in MuJoCo, same pose")
    for axes in (left, right):
        axes.set(xticks=[], yticks=[])
    bar = figure.colorbar(shown, ax=left, location="left", shrink=0.9, pad=0.02, ticks=(2, 5, 10, 20, 40), extend="max")
    bar.set_label("depth, m")
    bar.ax.minorticks_off()
    bar.ax.set_yticklabels(("2", "5", "10", "20", "40"))
    reach = np.linalg.norm(beam, axis=1)
    cast, _ = surface_caster(case).first(frame.origin, beam / np.maximum(reach, 1e-9)[:, None])
    error = np.abs(cast - reach)[np.isfinite(cast)]
    return figure, (
        f"{_DURATION:g} s of the recording, coloured by depth (a), and the MuJoCo scene from the same pose (b). "
        f"Along the recorded beams the scene is {100 * np.median(error):.1f} cm from the returns (median; "
        f"{100 * np.mean(error < 0.10):.1f} % within 10 cm)."
    )


def in_picture(pose: Pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 k"]:
    """Returns pixels across and down, and depth in m, of the points that a camera has in its picture."""
    local = (points - pose.position) @ pose.axes.T
    right, up, depth = local[local[:, 2] > _NEAREST].T
    across = 0.5 * pose.width + pose.focal * right / depth
    down = 0.5 * pose.height - pose.focal * up / depth
    inside = (np.abs(across / pose.width - 0.5) <= 0.5) & (np.abs(down / pose.height - 0.5) <= 0.5)
    return np.stack([across, down, depth])[:, inside]


def draw_figures(survey: Path, scene: Path) -> dict[str, Drawn | None]:
    """Draws figures 1 and 3 of a survey and the scene built from its Avia, with the OS1 held out.

    The third is that of a fidelity report.
    """
    candidate, (fitted, fit_poses, held, poses) = load_candidate(scene), (survey / name for name in SURVEY_FILES)
    case = Case(candidate, load_hold(held, poses, candidate.origin, HoldConfig(scan_spacing=0.5, sigma=0.03)))
    row = round(_FRAME_SHARE * (len(candidate.bore.station) - 1))
    frame = load_frame(fitted, fit_poses, candidate.origin, candidate.bore.position[row])
    sheet = Sheet(case, {"seed": 0, "split": {"hold": {"file": held.name}, "rule": "by sensor"}})
    return {
        "fig1": draw_bore_view(case, frame), "fig3a": draw_projections(sheet), "fig3b": draw_mismatch(sheet),
    }  # fmt: skip


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
        manifest = json.loads((config.scene / "manifest.json").read_text())
        provenance = f"Survey {config.survey.name}, {manifest.get('input_provenance')}."
        with plt.rc_context(_STYLE):
            for name, drawn in draw_figures(config.survey, config.scene).items():
                if drawn is not None:
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
