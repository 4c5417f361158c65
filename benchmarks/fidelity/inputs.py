"""What a command is given: a scene, what was held out of it, the truth; or the packaged tunnel."""

import json
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.fidelity.candidate import load
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.filehash import file_hash
from benchmarks.fidelity.references import HoldConfig, load_hold, load_truth
from scene.errors import SubterraError
from scene.files import require_input

PACKAGED = "subterra-351"
PACKAGED_LENGTH = 351
HELD_OUT = "os1"
SIGMA = {"os1": 0.03, "ouster": 0.03, "velodyne": 0.03, "vlp16": 0.03, "livox": 0.02}  # m, data sheets
FOREIGN = "foreign-scene"  # folder
FOREIGN_SEED = 1000


@dataclass(frozen=True)
class Inputs:
    """Files to judge and to judge by.

    Attributes:
        scene: Scene folder; the packaged `subterra-351`, made under `build/` if missing, where not given.
        recording: Held-out recording, which the builder has not read.
        trajectory: Poses of its LiDAR in the frame of the scene's input, TUM.
        truth: Folder of a simulated survey, for its truth.json and truth.ply.
        fit_recording: The recording that the builder read, for the gap between fit and hold.
        fit_trajectory: Its poses; those of `--trajectory` where not given.
        hold: How much of a recording is scored.
        seed: Of sampling, noise and bootstrap.
        strict: Count metrics without a reference as 0.
        out: Folder for everything that is written.
    """

    scene: Path | None = None
    recording: Path | None = None
    trajectory: Path | None = None
    truth: Path | None = None
    fit_recording: Path | None = None
    fit_trajectory: Path | None = None
    hold: HoldConfig = field(default_factory=HoldConfig)
    seed: int = 0
    strict: bool = False
    out: Path = Path("out/fidelity")


def completed(inputs: Inputs) -> Inputs:
    """The inputs as given, checked, or those of the packaged tunnel.

    Raises:
        SubterraError: A path does not exist.
        FidelityError: What is given does not go together.
    """
    if inputs.seed < 0:
        raise FidelityError(f"seed must not be negative, got {inputs.seed}")
    if inputs.scene is None:
        if inputs.recording or inputs.truth:
            raise FidelityError("--recording and --truth need --scene: what was reconstructed?")
        return packaged(inputs)
    for path in (inputs.scene, inputs.recording, inputs.trajectory, inputs.truth, inputs.fit_recording):
        if path is not None:
            require_input(path)
    if (inputs.recording is None) != (inputs.trajectory is None):
        raise FidelityError("--recording and --trajectory go together: points need poses")
    if inputs.fit_recording is not None and inputs.trajectory is None and inputs.fit_trajectory is None:
        raise FidelityError("--fit-recording needs --fit-trajectory or --trajectory: points need poses")
    return inputs


def read(inputs: Inputs) -> Case:
    """The case of completed inputs.

    Raises:
        FidelityError: A file is not what it should be.
        SubterraError: A recording cannot be read.
    """
    assert inputs.scene is not None
    candidate = load(inputs.scene)
    hold = fit = None
    if inputs.recording is not None and inputs.trajectory is not None:
        hold = load_hold(
            inputs.recording, inputs.trajectory, candidate.origin, with_sigma(inputs.hold, inputs.recording)
        )
    poses = inputs.fit_trajectory or inputs.trajectory
    if inputs.fit_recording is not None and poses is not None:
        fit = load_hold(inputs.fit_recording, poses, candidate.origin, inputs.hold)
        if fit.hash not in [entry.get("sha256") for entry in candidate.manifest.get("inputs", [])]:
            raise FidelityError(
                f"{inputs.fit_recording}: is not what {inputs.scene} was built from; its manifest has another SHA-256"
            )
    truth = None if inputs.truth is None else load_truth(inputs.truth, candidate.origin)
    return Case(candidate, hold, fit, truth, inputs.seed)


def with_sigma(config: HoldConfig, recording: Path) -> HoldConfig:
    """The data sheet's noise of the sensor that a recording's name tells, unless another was given."""
    if config.sigma != HoldConfig().sigma:
        return config
    known = [sigma for name, sigma in SIGMA.items() if name in recording.name.lower()]
    return replace(config, sigma=known[0]) if known else config


def packaged(inputs: Inputs) -> Inputs:
    """The packaged tunnel's scene and survey, made by the users' own commands where missing or not matching."""
    survey, scene = Path("build/survey-351"), Path("build") / PACKAGED
    fitted, held = survey / "survey.bag", survey / f"survey_{HELD_OUT}.bag"
    if not fitted.exists() or not held.exists():
        make("scene.survey", "--truth", "metro", "--length", PACKAGED_LENGTH, "--seed", 0,
             "--sensors", "avia", HELD_OUT, "--scan-every", 10, "--out", survey)  # fmt: skip
    if not built_from(scene, fitted):
        given = ("--trajectory", survey / "groundtruth.tum", "--provenance", "simulated", "--name", PACKAGED)
        make("scene.build", fitted, *given, "--out", scene)
    return replace(
        inputs, scene=scene, recording=held, trajectory=survey / f"groundtruth_{HELD_OUT}.tum",
        truth=survey, fit_recording=fitted, fit_trajectory=survey / "groundtruth.tum",
    )  # fmt: skip


def built_from(scene: Path, recording: Path) -> bool:
    """Whether a scene folder is there and its manifest has the recording's hash."""
    if not (scene / "manifest.json").exists():
        return False
    inputs = json.loads((scene / "manifest.json").read_text()).get("inputs", [])
    return file_hash(recording) in [entry.get("sha256") for entry in inputs]


def foreign(case: Case, folder: Path) -> Path:
    """A scene of another tunnel of the same class and length, made where it is missing, for N33."""
    scene = folder / FOREIGN
    if not (scene / "manifest.json").exists():
        survey = folder / "foreign-survey"
        make("scene.survey", "--length", round(case.candidate.length), "--seed", FOREIGN_SEED, "--out", survey)
        given = ("--trajectory", survey / "groundtruth.tum", "--provenance", "simulated")
        make("scene.build", survey / "survey.bag", *given, "--out", scene)
    return scene


def make(*words: object) -> None:
    """Runs `python -m ...` as a user would.

    Raises:
        SubterraError: It failed.
    """
    command = [str(word) for word in words]
    print(f"$ python -m {' '.join(command)}", flush=True)
    if subprocess.run([sys.executable, "-m", *command]).returncode:
        raise SubterraError(f"python -m {' '.join(command)} failed")
