"""The table of troubles, and the folder of cases that `benchmarks.dirty` judges."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tests.benchmarks.dirty.clouds import odd, others, recordings, troubles
from tests.benchmarks.dirty.clouds.files import FOOT, write_e57, write_laz, write_ply, write_truth, y_up
from tests.benchmarks.dirty.clouds.troubles import Cloud

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


def make_troubles(folder: Path, seed: int = 0, only: tuple[str, ...] = ()) -> None:
    """Writes the cases of the table, or those of some names, with their truth."""
    for name in only or TROUBLES:
        kind, case = TROUBLES[name]
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        if isinstance(case, CloudCase):
            _write_cloud(case, folder, name, kind, rng)
        else:
            _write_recording(case, folder, name, kind, rng, seed)


def _write_cloud(case: CloudCase, folder: Path, name: str, kind: str, rng: np.random.Generator) -> None:
    points, truth = case.make(rng)
    stored = case.stored(points)
    _WRITERS[case.ending](folder / f"{name}{case.ending}", stored)
    write_truth(folder / f"{name}_truth.npz", kind, {"cause": case.cause, **truth})


def _write_recording(
    case: RecordingCase, folder: Path, name: str, kind: str, rng: np.random.Generator, seed: int
) -> None:
    end = recordings.SUFFIX[case.sensor]
    survey = folder / f"survey{end}-{seed}"
    recordings.simulate_survey(survey, seed, sensors=(case.sensor,))
    if case.spoil is None:
        arguments = ["--control", f"{{folder}}/{survey.name}/prism.tum"]
    else:
        poses = recordings.spoil_poses(survey, name, case.spoil, case.sensor)
        arguments = ["--trajectory", f"{{folder}}/{survey.name}/{poses.name}"]
    truth = recordings.survey_truth(survey, rng, case.sensor)
    more = {"source": f"{survey.name}/survey{end}.bag", "arguments": arguments, "cause": case.cause}
    write_truth(folder / f"{name}_truth.npz", kind, {**truth, **more})
