"""Inputs of a command: scene, held-out recording and truth; and the cut of a recording into fit, val and hold."""

import json
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2

from benchmarks.command import run_module
from benchmarks.fidelity.candidate import Candidate, load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.files import FidelityError, file_hash, write_json
from benchmarks.fidelity.references import Hold, HoldConfig, load_hold, load_truth
from benchmarks.fidelity.windows.judge import LONG
from scene.config import check_number, check_settings
from scene.errors import require_input
from scene.progress import Stages
from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import replace_folder

PACKAGED = "subterra-351"
PACKAGED_LENGTH = 351
HELD_OUT = "os1"
SIGMA = {"os1": 0.03, "ouster": 0.03, "velodyne": 0.03, "vlp16": 0.03, "livox": 0.02}  # m, data sheets
FOREIGN = "foreign-scene"  # folder
FOREIGN_SEED = 1000


@dataclass(frozen=True)
class Inputs:
    """Files to judge and to judge by."""

    scene: Path | None = None  # Scene folder; None is the packaged `subterra-351`, made under `build/`.
    recording: Path | None = None  # Held-out recording, which the builder has not read.
    trajectory: Path | None = None  # Poses of its LiDAR in the frame of the scene's input, TUM.
    truth: Path | None = None  # Folder of a simulated survey, for its truth.json and truth.ply.
    fit_recording: Path | None = None  # The recording that the builder read, to compare with.
    fit_trajectory: Path | None = None  # Its poses; those of `--trajectory` where not given.
    hold: HoldConfig = field(default_factory=HoldConfig)  # Part of a recording to score.
    seed: int = 0  # Seed of sampling, noise and bootstrap.
    partial: bool = False  # Judge only the part that the recording shows.
    metrics: Path | None = None  # Python file with metrics and faults of your own, see docs/guide/extend.md.
    out: Path = Path("out/fidelity")  # Folder for all results.


def complete_inputs(inputs: Inputs) -> Inputs:
    """Checks the inputs; without a scene, return those of the packaged tunnel.

    Raises:
        SubterraError: A path does not exist.
        FidelityError: What is given does not go together.
    """
    check_number("seed", inputs.seed)
    check_settings(inputs.hold)
    if inputs.scene is None:
        if inputs.recording or inputs.truth:
            raise FidelityError("--recording and --truth need --scene: what was reconstructed?")
        return packaged_inputs(inputs)
    for path in (inputs.scene, inputs.recording, inputs.trajectory, inputs.truth, inputs.fit_recording,
                 inputs.fit_trajectory):  # fmt: skip
        if path is not None:
            require_input(path)
    if (inputs.recording is None) != (inputs.trajectory is None):
        raise FidelityError("--recording and --trajectory go together: points need poses")
    if inputs.fit_recording is not None and inputs.trajectory is None and inputs.fit_trajectory is None:
        raise FidelityError("--fit-recording needs --fit-trajectory or --trajectory: points need poses")
    return inputs


def read_case(inputs: Inputs, processes: int = 1) -> Case:
    """Reads the case of completed inputs; with two processes or more the builder's recording is read beside the rest.

    Raises:
        FidelityError: A file is not what it should be.
        SubterraError: A recording cannot be read.
    """
    assert inputs.scene is not None
    candidate = load_candidate(inputs.scene)
    hold = fit = None
    poses = inputs.fit_trajectory or inputs.trajectory
    with ExitStack() as stack:
        fitted: Callable[[], Hold] | None = None
        if inputs.fit_recording is not None and poses is not None:
            fitted = partial(load_hold, inputs.fit_recording, poses, candidate.origin, inputs.hold)
            if processes > 1:
                pool = stack.enter_context(ProcessPoolExecutor(1, multiprocessing.get_context("spawn")))
                fitted = pool.submit(fitted).result
        if inputs.recording is not None and inputs.trajectory is not None:
            noise = with_sigma(inputs.hold, inputs.recording)
            hold = load_hold(inputs.recording, inputs.trajectory, candidate.origin, noise)
            check_recording(candidate, hold, inputs.scene, inputs.recording, inputs.partial)
        truth = None if inputs.truth is None else load_truth(inputs.truth, candidate.origin)
        if fitted is not None:
            fit = fitted()
            if fit.hash not in [entry.get("sha256") for entry in candidate.manifest.get("inputs", [])]:
                raise FidelityError(
                    f"{inputs.fit_recording}: is not what {inputs.scene} was built from; "
                    "its manifest has another SHA-256"
                )
    case = Case(candidate, hold, fit, truth, inputs.seed)
    if case.has("reference"):
        check_length(candidate, inputs.scene)
    return case


def with_sigma(config: HoldConfig, recording: Path) -> HoldConfig:
    """Return the data sheet's noise of the sensor in a recording's name, unless another was given."""
    if config.sigma != HoldConfig().sigma:
        return config
    known = [sigma for name, sigma in SIGMA.items() if name in recording.name.lower()]
    return replace(config, sigma=known[0]) if known else config


def packaged_inputs(inputs: Inputs) -> Inputs:
    """Return scene and survey of the packaged tunnel, made by the users' own commands where missing or changed."""
    survey, scene = Path("build/survey-351"), Path("build") / PACKAGED
    fitted, held = survey / "survey.bag", survey / f"survey_{HELD_OUT}.bag"
    if not fitted.exists() or not held.exists():
        make("scene.survey", "--truth", "metro", "--length", PACKAGED_LENGTH, "--seed", 0,
             "--sensors", "avia", HELD_OUT, "--scan-every", 10, "--out", survey)  # fmt: skip
    if not is_built_from(scene, fitted):
        given = ("--trajectory", survey / "groundtruth.tum", "--provenance", "simulated", "--name", PACKAGED)
        make("scene.build", fitted, *given, "--out", scene)
    return replace(
        inputs, scene=scene, recording=held, trajectory=survey / f"groundtruth_{HELD_OUT}.tum",
        truth=survey, fit_recording=fitted, fit_trajectory=survey / "groundtruth.tum",
    )  # fmt: skip


def is_built_from(scene: Path, recording: Path) -> bool:
    """Return True where a scene folder exists and its manifest has the recording's hash."""
    if not (scene / "manifest.json").exists():
        return False
    inputs = json.loads((scene / "manifest.json").read_text()).get("inputs", [])
    return file_hash(recording) in [entry.get("sha256") for entry in inputs]


def foreign_scene(case: Case, folder: Path) -> Path:
    """Return a scene of another tunnel of the same class and length for N33, made where it is missing."""
    scene = folder / FOREIGN
    if not (scene / "manifest.json").exists():
        survey = folder / "foreign-survey"
        make("scene.survey", "--length", round(case.candidate.length), "--seed", FOREIGN_SEED, "--out", survey)
        given = ("--trajectory", survey / "groundtruth.tum", "--provenance", "simulated")
        make("scene.build", survey / "survey.bag", *given, "--out", scene)
    return scene


def make(module: str, *words: object) -> None:
    """Runs `python -m MODULE WORDS` as a user would; raises `SubterraError` where it fails."""
    if run_module(module, *words).status:
        raise SubterraError(f"python -m {' '.join(map(str, (module, *words)))} failed")


# The cut of a recording into fit, val and hold, by blocks of time.

SPLIT_PARTS = ("fit", "val", "hold")
GUARD = -1
SPLIT_SCHEMA = "subterra.split/1"


@dataclass(frozen=True)
class SplitConfig:
    """Rule of the cut."""

    block: float = 2.0  # Length of a block, s.
    guard: float = 0.2  # Left out around every border between parts, s.
    fractions: tuple[float, float, float] = (0.6, 0.2, 0.2)  # Fractions of fit, val and hold.
    seed: int = 0  # Seed of the order of the blocks.


def deal_blocks(duration: float, config: SplitConfig) -> Int[np.ndarray, " b"]:
    """Return the part of each block of a recording of some seconds.

    Blocks are dealt in hands of five, each with the parts in their fractions, so that every part sees the whole
    tunnel; the order within a hand is drawn.
    """
    hand = np.repeat(np.arange(3), np.round(5 * np.asarray(config.fractions)).astype(int))
    rng = np.random.default_rng(config.seed)
    return np.concatenate([rng.permutation(hand) for _ in range(int(duration / config.block) // len(hand) + 2)])


def part_at(time: float, dealt: Int[np.ndarray, " b"], config: SplitConfig) -> int:
    """Return 0 fit, 1 val or 2 hold for a time since the start, s; -1 within the guard of a border."""
    block = int(time // config.block)
    into = time - block * config.block
    if block and into < 0.5 * config.guard and dealt[block - 1] != dealt[block]:
        return GUARD
    if config.block - into <= 0.5 * config.guard and dealt[block + 1] != dealt[block]:
        return GUARD
    return int(dealt[block])


def split_recording(recording: Path, out: Path, config: SplitConfig) -> dict[str, Any]:
    """Writes `fit.bag`, `val.bag` and `hold.bag` with the messages as they were recorded, and `split.json`.

    Raises:
        FidelityError: It is no bag, or too short to give every part a block.
    """
    require_input(recording)
    check_settings(config)
    fifths = np.round(5 * np.asarray(config.fractions))
    if fifths.sum() != 5 or (fifths < 1).any():
        raise FidelityError(f"fractions must be fifths, each at least one, that sum to 1, got {config.fractions}")
    if config.guard >= config.block:
        raise FidelityError(f"guard must be shorter than a block of {config.block:g} s, got {config.guard:g}")
    with _open_bag(recording) as reader, replace_folder(out, "split.json") as folder:
        counts = _copy_messages(reader, folder, config, recording)
        facts = {
            "schema": SPLIT_SCHEMA, "rule": asdict(config), "messages": counts,
            "recording": _file_record(recording),
            "parts": {name: _file_record(folder / _part_name(name, recording)) for name in SPLIT_PARTS},
        }  # fmt: skip
        write_json(folder / "split.json", facts)
    return facts


def _open_bag(recording: Path) -> "closing[Any]":
    try:
        reader = Reader1(recording) if recording.suffix == ".bag" else AnyReader([recording])
        reader.open()
    except Exception as error:
        raise FidelityError(f"{recording}: is no bag that can be split ({error})") from error
    return closing(reader)


def _copy_messages(reader: Any, folder: Path, config: SplitConfig, recording: Path) -> dict[str, int]:
    duration = (reader.end_time - reader.start_time) * 1e-9
    if duration < 5 * config.block:
        raise FidelityError(f"{recording}: is shorter than five blocks of {config.block:g} s")
    dealt, counts = deal_blocks(duration, config), dict.fromkeys((*SPLIT_PARTS, "guard"), 0)
    with ExitStack() as stack, Stages() as progress:
        make: Callable[[Path], Any] = Writer1 if recording.suffix == ".bag" else partial(Writer2, version=9)
        writers = [stack.enter_context(make(folder / _part_name(name, recording))) for name in SPLIT_PARTS]
        channels = [{c.id: _add_channel(writer, c) for c in reader.connections} for writer in writers]
        stage = progress.start("split", reader.message_count)
        for connection, stamp, raw in reader.messages():
            part = part_at((stamp - reader.start_time) * 1e-9, dealt, config)
            counts["guard" if part == GUARD else SPLIT_PARTS[part]] += 1
            if part != GUARD:
                writers[part].write(channels[part][connection.id], stamp, raw)
            stage.advance()
    return counts


def _file_record(path: Path) -> dict[str, str]:
    return {"file": path.name, "sha256": file_hash(path)}


def _add_channel(writer: Any, connection: Any) -> Any:
    digest = {"md5sum" if isinstance(writer, Writer1) else "rihs01": connection.digest}
    return writer.add_connection(connection.topic, connection.msgtype, msgdef=connection.msgdef.data, **digest)


def _part_name(part: str, recording: Path) -> str:
    return f"{part}.bag" if recording.suffix == ".bag" else part


# Checks before anything is judged: the recording lies in the scene's frame and shows all of the tunnel.

_BESIDE = 2.0  # largest radii from the axis at which a sensor or a return is still in the tunnel
_FEWEST = 30  # returns that show a metre of the tunnel
_SHOWN = 0.95  # fraction of the tunnel that must be shown
_THINNED = 200_000  # returns that are looked at


def check_length(candidate: Candidate, scene: Path) -> None:
    """Refuses a tunnel that is shorter than a window."""
    if candidate.length < LONG:
        raise FidelityError(
            f"{scene}: its tunnel is {candidate.length:.1f} m long, and a window along it {LONG:g} m; "
            "a shorter tunnel cannot be judged by windows"
        )


def check_recording(candidate: Candidate, hold: Hold, scene: Path, recording: Path, partial: bool = False) -> None:
    """Refuses a recording in another frame, or one that shows only a part of the tunnel."""
    line = Curve(candidate.bore.station, candidate.bore.position)
    first = np.unique(hold.scan, return_index=True)[1]
    local = line.local(hold.origin[first])
    reach = _BESIDE * float(np.nanmax(candidate.bore.radius))
    beyond = np.maximum(np.maximum(-local[:, 0], local[:, 0] - candidate.length), 0.0)
    away = float(np.median(np.hypot(np.hypot(local[:, 1], local[:, 2]), beyond)))
    if away > reach:
        raise FidelityError(
            f"{recording}: its sensor lies {away:.0f} m from the tunnel of {scene}; "
            "its poses are not in the frame of the scene's input"
        )
    shown = _shown_metres(line, hold, reach)
    if not partial and shown.mean() < _SHOWN:
        gaps = np.flatnonzero(~shown)
        raise FidelityError(
            f"{recording}: shows {int(shown.sum())} of the {len(shown)} m of {scene}, nothing for instance at station "
            f"{gaps[len(gaps) // 2]} m; what is not shown cannot be judged (--partial judges the rest)"
        )


def _shown_metres(line: Curve, hold: Hold, reach: float) -> Bool[np.ndarray, " m"]:
    """Return True for each metre of the tunnel with returns on it."""
    points = hold.points
    thin = max(len(points) // _THINNED, 1)
    local = line.local(points[::thin])
    near = np.hypot(local[:, 1], local[:, 2]) < reach
    count = max(int(line.length), 1)
    metre = np.floor(local[near, 0] / line.length * count).astype(int)
    inside = (metre >= 0) & (metre < count)
    return np.bincount(metre[inside], minlength=count) * thin >= _FEWEST
