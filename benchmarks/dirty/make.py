"""Folders of cases for `benchmarks.dirty`: clouds with one trouble each, and mutations of clouds that are there.

Example: python -m benchmarks.dirty.make troubles --out out/dirty/troubles
"""

import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console

from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.dirty.clouds import odd, others, recordings, troubles
from benchmarks.dirty.clouds.files import FOOT, write_e57, write_laz, write_ply, write_truth, y_up
from benchmarks.dirty.clouds.mutations import MUTATIONS, Mutant, read_mutant
from benchmarks.dirty.clouds.troubles import Cloud
from benchmarks.dirty.truth import find_cases
from subterra_jax.host.files import require_folder

_progress = Console(stderr=True, highlight=False)

Maker = Callable[[np.random.Generator], Cloud]
Frame = Callable[[np.ndarray], np.ndarray]
LidarName = Literal["avia", "vlp16", "os1"]


@dataclass(frozen=True)
class CloudCase:
    """A trouble of a cloud, and the form in which it is written."""

    make: Maker  # Makes points in m and their truth
    stored: Frame = np.asarray  # Takes points in m to what is stored
    ending: str = ".laz"  # A key of `_WRITERS`
    cause: tuple[str, ...] = ()  # As for a recording; that of the truth where it has one


@dataclass(frozen=True)
class RecordingCase:
    """A mistake in what comes with a recording."""

    spoil: recordings.Spoil | None  # Spoils the true poses; `None`: a prism instead of poses, without its mount
    cause: tuple[str, ...]  # Words of which a warning or refusal names at least one
    sensor: LidarName = "avia"


_CLOCK = ("clock", "late", "lag", "time", "offset", "thick", "blur")
_FRAME = ("axes", "unit", "y up", "feet", "ft", "mm")
_MOUNT = ("extrinsic", "mount", "calibration", "pitch", "thick", "blur", "attitude")

# Rows of the table of issues: what was built wrong without a word ...
SILENT: dict[str, CloudCase | RecordingCase] = {
    "clean": CloudCase(troubles.clean),
    "outliers": CloudCase(troubles.outliers),
    "ghosts": CloudCase(troubles.ghosts),
    "vehicle": CloudCase(troubles.vehicle),
    "train": CloudCase(troubles.train),
    "left-wall-unseen": CloudCase(troubles.left_wall),
    "y-up": CloudCase(troubles.clean, y_up, cause=_FRAME),
    "feet": CloudCase(troubles.clean, lambda points: points / FOOT, cause=_FRAME),
    "floor-unseen": CloudCase(troubles.low_floor),
    "gap": CloudCase(troubles.gap),
    "niche-1m": CloudCase(troubles.niche(1.0)),
    "niche-2.5m": CloudCase(troubles.niche(2.5)),
    "stub-5m": CloudCase(troubles.niche(5.0)),
    "pitch-3deg": RecordingCase(recordings.pitched, _MOUNT),
    "late-0.1s": RecordingCase(recordings.late(0.1), _CLOCK),
    "control-uncalibrated": RecordingCase(None, ("calibration", "mount", "lever", "prism")),
    "duct": CloudCase(troubles.duct),
    "pillars": CloudCase(troubles.pillars),
    "crown-unseen": CloudCase(troubles.crown),
}
# ... what was refused with a wrong reason ...
REFUSED: dict[str, CloudCase | RecordingCase] = {
    "cutting-3m": CloudCase(troubles.cutting(3.0)),
    "cutting-6m": CloudCase(troubles.cutting(6.0)),
    "cutting-10m": CloudCase(troubles.cutting(10.0)),
    "vegetation": CloudCase(troubles.vegetation),
    "road-kerbs": CloudCase(troubles.road),
    "road-r80": CloudCase(troubles.road_bend),
    "skewed-portal": CloudCase(troubles.skewed),
    "quaternion-wxyz": RecordingCase(recordings.scalar_first, ("quaternion", "wxyz", "w x y z", "scalar", "order")),
    "clock-0.5s": RecordingCase(recordings.late(0.5), _CLOCK),
    "e57-mm": CloudCase(troubles.clean, lambda points: 1000.0 * points, ".e57", _FRAME),
}
# ... what was tried later, of other kinds ...
ODD: dict[str, CloudCase | RecordingCase] = {
    "s-curve": CloudCase(odd.s_curve),
    "hairpin": CloudCase(odd.hairpin),
    "steep": CloudCase(odd.steep),
    "section-change": CloudCase(odd.section_change),
    "t-junction": CloudCase(odd.junction(np.pi / 2)),
    "y-junction": CloudCase(odd.junction(np.pi / 6)),
    "passes-5cm": CloudCase(odd.two_passes(0.05)),
    "passes-15cm": CloudCase(odd.two_passes(0.15)),
    "few-stations": CloudCase(odd.few_stations),
    "profiles": CloudCase(odd.profiles),
    "wet-floor": CloudCase(odd.wet_floor),
    "pipe": CloudCase(odd.pipe),
    "hall": CloudCase(odd.hall),
    "rounded": CloudCase(odd.rounded, ending=".ply"),
    "origin-rows": CloudCase(odd.origin_rows),
    "rock": CloudCase(odd.rock),
    "floor-step": CloudCase(odd.floor_step),
    "culvert": CloudCase(odd.culvert),
    "three-lanes": CloudCase(odd.three_lanes),
    "mine-bend": CloudCase(odd.mine_bend),
    "two-pieces": CloudCase(odd.two_pieces),
    "twin": CloudCase(odd.twin),
    "vlp16-pitch-3deg": RecordingCase(recordings.pitched, _MOUNT, "vlp16"),
    "vlp16-roll-2deg": RecordingCase(recordings.rolled, ("roll",), "vlp16"),
}
# ... and what is no tunnel, or two.
BAD: dict[str, CloudCase | RecordingCase] = {
    "room": CloudCase(others.room),
    "street": CloudCase(others.street),
    "plane": CloudCase(others.plane),
    "shaft": CloudCase(others.shaft),
    "two-tunnels": CloudCase(others.two_tunnels),
}
_KINDS = (("silent", SILENT), ("refused", REFUSED), ("odd", ODD), ("bad", BAD))
_WRITERS = {".laz": write_laz, ".e57": write_e57, ".ply": write_ply}
TROUBLES = {name: (kind, case) for kind, cases in _KINDS for name, case in cases.items()}


@dataclass(frozen=True)
class TroublesConfig:
    """Makes clouds and recordings with one trouble each, and their truth.

    Attributes:
        out: Folder for the cases; those that are there are kept.
        seed: Draws places, courses, noise and the troubles.
        only: Names wanted; all if not given.
    """

    out: Path
    seed: int = 0
    only: tuple[str, ...] = ()


def make_troubles(config: TroublesConfig) -> None:
    """Writes the cases of the table.

    Raises:
        BenchmarkError: A name is not in the table, or a survey fails.
        OutputError: The folder cannot be written.
    """
    require_least(config, seed=0)
    unknown = set(config.only) - set(TROUBLES)
    if unknown:
        raise BenchmarkError(f"no trouble {min(unknown)!r}; there are {', '.join(TROUBLES)}")
    require_folder(config.out)
    for name in config.only or TROUBLES:
        truth = config.out / f"{name}_truth.npz"
        if truth.is_file():
            continue
        kind, case = TROUBLES[name]
        rng = np.random.default_rng([config.seed, zlib.crc32(name.encode())])
        write = partial(_write_cloud, case) if isinstance(case, CloudCase) else partial(_write_recording, case)
        write(config, name, kind, truth, rng)
        _progress.print(f"{name}: made")


def _write_cloud(
    case: CloudCase, config: TroublesConfig, name: str, kind: str, path: Path, rng: np.random.Generator
) -> None:
    points, truth = case.make(rng)
    stored = case.stored(points)
    _WRITERS[case.ending](config.out / f"{name}{case.ending}", stored)
    write_truth(path, kind, {"cause": case.cause, **truth})


def _write_recording(
    case: RecordingCase, config: TroublesConfig, name: str, kind: str, path: Path, rng: np.random.Generator
) -> None:
    end = recordings.SUFFIX[case.sensor]
    survey = config.out / f"survey{end}-{config.seed}"
    recordings.simulate_survey(survey, config.seed, sensors=(case.sensor,))
    if case.spoil is None:
        arguments = ["--control", f"{{folder}}/{survey.name}/prism.tum"]
    else:
        poses = recordings.spoil_poses(survey, name, case.spoil, case.sensor)
        arguments = ["--trajectory", f"{{folder}}/{survey.name}/{poses.name}"]
    truth = recordings.survey_truth(survey, rng, case.sensor)
    more = {"source": f"{survey.name}/survey{end}.bag", "arguments": arguments, "cause": case.cause}
    write_truth(path, kind, {**truth, **more})


@dataclass(frozen=True)
class MutationsConfig:
    """Makes mutations of the clouds of a folder, and their truth.

    Attributes:
        folder: Folder with clouds and their truth, as `benchmarks.dirty` judges them.
        out: Folder for the mutations; those that are there are kept.
        count: Number of mutations; kinds come in turn, and each kind takes the clouds in turn.
        first: Number of the first; several processes can so make a part each.
        seed: Draws all that is drawn.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    out: Path
    count: int = 200
    first: int = 0
    seed: int = 0


def make_mutations(config: MutationsConfig) -> None:
    """Writes the mutations.

    Raises:
        BenchmarkError: The folder holds no clouds with truth.
        OutputError: The folder for the mutations cannot be written.
    """
    require_least(config, count=1, first=0, seed=0)
    require_folder(config.out)
    cases, kinds = find_cases(config.folder), list(MUTATIONS)
    wholes: dict[str, Mutant] = {}
    for number in range(config.first, config.first + config.count):
        kind, case = kinds[number % len(kinds)], cases[number // len(kinds) % len(cases)]
        name = f"{number:03d}-{kind}-{case.name}"
        path = config.out / f"{name}_truth.npz"
        if path.is_file():
            continue
        if case.name not in wholes:
            wholes = {case.name: read_mutant(case)}
        mutant = MUTATIONS[kind](np.random.default_rng([config.seed, number]), wholes[case.name])
        write_laz(config.out / f"{name}.laz", mutant.points)
        truth = {field: value for field, value in vars(mutant.truth).items() if field not in ("cause", "trouble")}
        write_truth(path, kind, truth)
        _progress.print(f"{name}: made")


@dataclass(frozen=True)
class SurveysConfig:
    """Simulates surveys, and makes a case of each sensor and source of poses.

    Attributes:
        out: Folder for the cases; those that are there are kept.
        truths: Kinds of bore; see `python -m scene.survey --help`.
        sensors: LiDARs on the rack.
        poses: `given`: true poses; `control`: odometry, IMU and prism.
        length: Length of each bore, m.
        seed: Seed of the surveys.
    """

    out: Path
    truths: tuple[str, ...] = ("portal", "corridor", "works", "platform", "road", "slabtrack")
    sensors: tuple[LidarName, ...] = ("avia", "vlp16", "os1")
    poses: tuple[Literal["given", "control"], ...] = ("given", "control")
    length: float = 40.0
    seed: int = 0


def make_surveys(config: SurveysConfig) -> None:
    """Simulates the surveys and writes their cases.

    Raises:
        BenchmarkError: A survey fails.
        OutputError: The folder cannot be written.
    """
    require_least(config, seed=0)
    require_folder(config.out)
    for truth in config.truths:
        survey = config.out / f"survey-{truth}-{config.seed}"
        recordings.simulate_survey(survey, config.seed, truth, config.length, config.sensors)
        for sensor in config.sensors:
            fields = recordings.survey_truth(survey, np.random.default_rng(config.seed), sensor)
            end = recordings.SUFFIX[sensor]
            given = ["--trajectory", f"{{folder}}/{survey.name}/groundtruth{end}.tum"]
            control = ["--control", f"{{folder}}/{survey.name}/prism.tum"]
            control += ["--calibration", f"{{folder}}/{survey.name}/calibration{end}.yaml"]
            for poses in config.poses:
                name = f"{truth}-{sensor}-{poses}-{config.seed}"
                words = [*(given if poses == "given" else control), "--provenance", "simulated"]
                more = {"source": f"{survey.name}/survey{end}.bag", "arguments": words}
                write_truth(config.out / f"{name}_truth.npz", f"{sensor}-{poses}", {**fields, **more})
        _progress.print(f"{survey.name}: made")


_TROUBLES = "Make clouds and recordings with one trouble each, and their truth."
_SURVEYS = "Simulate surveys of places as scanners meet them, a case for each sensor and source of poses."
_MUTATIONS = "Make mutations of the clouds of a folder, and their truth."
Command: Any = (
    Annotated[TroublesConfig, tyro.conf.subcommand("troubles", description=_TROUBLES)]
    | Annotated[SurveysConfig, tyro.conf.subcommand("surveys", description=_SURVEYS)]
    | Annotated[MutationsConfig, tyro.conf.subcommand("mutations", description=_MUTATIONS)]
)


def make(config: TroublesConfig | SurveysConfig | MutationsConfig) -> None:
    """Makes the cases that are asked for."""
    if isinstance(config, TroublesConfig):
        make_troubles(config)
    elif isinstance(config, SurveysConfig):
        make_surveys(config)
    else:
        make_mutations(config)


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("dirty.make", Command, make, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
