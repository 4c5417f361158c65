"""One short drive in conventions drawn at random: read as it was, or refused for the true reason?

`python -m benchmarks.recordings --count 300 --out out/recordings` writes `records.json` and a row for each recording.
"""

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from jaxtyping import Float

from benchmarks.command import BenchmarkError, run_main
from benchmarks.records import Record, measured, write_records
from benchmarks.results import markdown_table
from scene.build import reconstruct
from scene.config import ReconstructConfig
from scene.poses.calibration import load_calibration
from scene.poses.clocks import settle
from scene.poses.imu import find_inertial
from scene.poses.trajectory import Trajectory, load_tum, save_tum
from scene.progress import Stages
from scene.reading.formats import ReadingConfig
from scene.reading.recording import Recording
from scene.survey.bore import draw_bore
from scene.survey.carrier import LIDARS, Carried, calibration, draw_walk
from scene.survey.cast import Caster, sweeps
from scene.survey.config import SensorErrors, SurveyConfig
from scene.survey.conventions import Convention
from scene.survey.lidar import SCAN_PERIOD, VLP16_RINGS, Lidar, Sweep, vlp16
from scene.survey.messages import EPOCH
from scene.survey.simulate import TRUTH_RATE, draw_imu_messages, make_device, write_recording
from scene.survey.write import write_tum

_EVERY = 6  # firings of the VLP-16 of which one is kept
_COMPARED = 12  # sweeps of a recording that are compared point by point
_LATE, _CLOCK = 0.005, 0.010  # s: errors of a point's time, and of a clock, that count as noise
_MOST_BAD = 0.05  # share of bad times that the reader states as its limit
_ODDS: dict[str, dict[Any, int]] = {  # of each value of a convention
    "point_times": {"driver": 1, "header": 5, "sweep": 4, "epoch": 4, "boot": 6, "constant": 1, "none": 1},
    "point_unit": {"s": 1, "ms": 1, "us": 1, "ns": 1},
    "point_type": {"f4": 1, "f8": 1, "u4": 1},
    "point_field": {"timestamp": 1, "time": 1, "t": 1, "offset_time": 1},
    "header_of": {"start": 1, "end": 1},
    "boot": {4.0: 1, 320.0: 1, 1500.0: 1, 30000.0: 1, 4e6: 1},
    "bad_times": {0.0: 4, 0.001: 1, 0.01: 1, 0.03: 1, 0.1: 1},
    "by_ring": {False: 1, True: 1},
    "big_endian": {False: 3, True: 1},
    "container": {"bag": 2, "mcap": 1, "db3": 1},
    "bags": {1: 2, 2: 1, 3: 1},
}
Outcome = Literal["as control", "static, as said", "refused, true reason", "refused, other reason", "wrong in silence"]
OUTCOMES: tuple[Outcome, ...] = (
    "as control", "static, as said", "refused, true reason", "refused, other reason", "wrong in silence",
)  # fmt: skip
_DECIDED = {"after": "header", "same clock": "epoch", "other clock": "other clock", "static": "static", "": "refused"}


@dataclass(frozen=True)
class RecordingsConfig:
    """Writes one drive in many conventions and reads each. Those that `out` has rows of are not read again."""

    count: int = 300  # Recordings.
    seed: int = 0  # Draws the drive and the conventions.
    length: float = 12.0  # Length of the bore, m.
    built: int = 6  # Recordings that are built whole, and their bores compared.
    out: Path = Path("out/recordings")  # Output folder.


@dataclass(frozen=True)
class Drive:
    """One drive, to be written in any convention."""

    config: SurveyConfig
    lidar: Lidar
    carried: Carried
    sweeps: list[Sweep]
    poses: Trajectory  # True ones of the LiDAR


@dataclass(frozen=True)
class Case:
    """One recording and whose clock is compared with the LiDAR's."""

    convention: Convention
    beside: Literal["nothing", "trajectory", "IMU"]
    late: float  # Of that clock, s


@dataclass(frozen=True)
class Row:
    """Outcome of a recording."""

    case: Case
    outcome: Outcome
    decided: str  # What its times were taken for
    said: str  # Sentence printed, or the refusal


def drive_through(config: RecordingsConfig, folder: Path) -> Drive:
    """Simulates the drive: a VLP-16 with fewer firings."""
    survey = SurveyConfig(folder, length=max(config.length, 10.5), sensors=("vlp16",), seed=config.seed)
    of_bore, of_walk, of_lidar = np.random.SeedSequence(config.seed).spawn(3)
    bore = draw_bore(of_bore, survey.length, survey.truth, survey.correlation, survey.tolerances)
    walk = draw_walk(np.random.default_rng(of_walk), bore, survey.speed, SCAN_PERIOD)
    carried, whole = Carried(walk, LIDARS["vlp16"]), vlp16()
    seen = sweeps(
        np.random.default_rng(of_lidar), whole, carried, Caster(bore.mesh(), whole.range_max), SensorErrors(), 1
    )
    kept = np.flatnonzero(np.arange(len(whole.offset)) // VLP16_RINGS % _EVERY == 0)
    names = ("offset", "valid", "points", "reflectivity", "second", "placed")
    thin = [replace(sweep, **{name: getattr(sweep, name)[kept] for name in names}) for sweep in seen]
    lidar = replace(whole, offset=whole.offset[kept], line=whole.line[kept])
    time = np.arange(round(walk.duration * TRUTH_RATE) + 1) / TRUTH_RATE
    poses = carried.poses(time)
    write_tum(folder / "poses.tum", time, poses.position, poses.quaternion)
    (folder / "calibration.yaml").write_text(yaml.safe_dump(calibration("vlp16")))
    return Drive(survey, lidar, carried, thin, load_tum(folder / "poses.tum"))


def draw_case(rng: np.random.Generator) -> Case:
    """Draws a convention that a driver could have, and whose clock is beside it."""
    while True:
        values = {name: _draw(rng, odds) for name, odds in _ODDS.items()}
        beside = _draw(rng, {"nothing": 1, "trajectory": 2, "IMU": 2})
        late = float(rng.uniform(-1.2, 1.2)) if rng.random() < 0.5 else 0.0
        late = -2e8 if beside == "IMU" and rng.random() < 0.1 else late
        convention = Convention(**values, imu_late=late if beside == "IMU" else 0.0)
        try:
            convention.check()
        except ValueError:
            continue
        if convention.point_times not in ("driver", "constant", "none") or convention.bad_times == 0.0:
            return Case(convention, beside, late)


def _draw(rng: np.random.Generator, odds: dict[Any, int]) -> Any:
    weights = np.array(list(odds.values()), float)
    return list(odds)[int(rng.choice(len(odds), p=weights / weights.sum()))]


def write_case(drive: Drive, case: Case, path: Path) -> Path:
    """Writes the drive in a convention; returns what a user would name."""
    config = replace(drive.config, convention=case.convention)
    device = replace(make_device("vlp16", config), lidar=drive.lidar)
    inertial = draw_imu_messages(list(np.random.SeedSequence(1).spawn(1)), "vlp16", drive.carried, config)
    return write_recording(path, device, drive.sweeps, inertial, None, case.convention, len(drive.sweeps))[0]


def read_case(drive: Drive, case: Case, path: Path) -> Row:
    """Reads a recording as a build does, with `--clock auto`, and compares points, times and clocks with the truth."""
    try:
        with Recording(path) as recording:
            recording.peek()
            lag, error = None, 0.0
            if case.beside == "trajectory":
                late = replace(drive.poses, times=drive.poses.times + case.late)
                lag = settle(recording, late, True)[0].offset
            elif case.beside == "IMU":
                inertial, _ = find_inertial(recording, load_calibration(path.parent / "calibration.yaml"))
                if inertial is not None:
                    lag = settle(recording, inertial, True)[0].offset
            times = recording.convention
            error = time_error(drive, case, recording, case.late - (lag or 0.0))
            said = recording.facts["point_times"]
    except Exception as refused:  # a defect is a wrong reason, too
        share = case.convention.bad_times
        true = share > _MOST_BAD and "% of the points" in str(refused) and "none of their sweep" in str(refused)
        return Row(case, "refused, true reason" if true else "refused, other reason", "refused", repr(refused))
    said = f"{said}; clock {lag}, times off by {error:.4f} s"
    if times.kind == "static" and case.convention.point_times in ("constant", "none"):
        return Row(case, "static, as said", "static", said)
    limit = _LATE if case.beside == "nothing" else _CLOCK
    return Row(case, "as control" if error <= limit else "wrong in silence", _DECIDED[times.kind], said)


def time_error(drive: Drive, case: Case, recording: Recording, late: float) -> float:
    """Return the largest error of a good point's time, s; infinite where sweeps are missing or points are others.

    It counts against the clock beside the LiDAR, which is still `late`, s. Without one, a shift of all times is none.
    """
    scans, errors = list(recording.scans()), []
    if len(scans) != len(drive.sweeps):
        return np.inf
    for k in np.linspace(0, len(scans) - 1, _COMPARED).astype(int):
        sweep, scan = drive.sweeps[k], scans[k]
        points, at = sweep.points[sweep.valid], EPOCH + 1e-9 * (sweep.begin + sweep.offset[sweep.valid])
        index = {point.tobytes(): i for i, point in enumerate(points.astype(np.float32))}
        found = [index.get(point.tobytes(), -1) for point in scan.points.astype(np.float32)]
        if -1 in found or len(found) < (1.0 - 2.0 * case.convention.bad_times) * len(points) - 9:
            return np.inf
        errors.append(scan.stamp + scan.times - at[found])
    off = np.concatenate(errors)
    off = np.abs(off - (np.median(off) if case.beside == "nothing" else late))
    return float(np.quantile(off, 1.0 - case.convention.bad_times))  # a bad time may look like one of the sweep


def build_case(drive: Drive, case: Case, path: Path) -> Float[np.ndarray, "n m"]:
    """Builds the bore of a recording with its poses and `--clock auto`; returns its radii, m."""
    poses = path.parent / "late.tum"
    save_tum(replace(drive.poses, times=drive.poses.times + (case.late if case.beside == "trajectory" else 0.0)), poses)
    config = replace(ReconstructConfig(), reading=ReadingConfig(clock="auto"))
    with Stages() as stages:
        return np.asarray(reconstruct(path, poses, config, stages).bore.radius)


def measure(config: RecordingsConfig) -> tuple[list[Row], list[float]]:
    """Writes and reads all recordings; builds some. Returns their rows, and the largest difference of each bore, m."""
    rows, apart = _known(config.out / "rows.jsonl")[: config.count], list[float]()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        drive = drive_through(config, folder)
        control = Case(Convention(), "nothing", 0.0)
        bore = build_case(drive, control, write_case(drive, control, folder / "control.bag")) if config.built else None
        for k in range(len(rows), config.count):
            case = draw_case(np.random.default_rng([config.seed, k]))
            path = write_case(drive, case, folder / f"{k}.bag")
            rows.append(read_case(drive, case, path))
            if bore is not None and len(apart) < config.built and rows[-1].outcome == "as control":
                built = build_case(drive, case, path)
                same = built.shape == bore.shape
                apart.append(float(np.sqrt(np.mean((built - bore) ** 2))) if same else np.inf)
            _remove(path)
            with (config.out / "rows.jsonl").open("a") as lines:
                lines.write(json.dumps(asdict(rows[-1])) + "\n")
            if rows[-1].outcome in OUTCOMES[3:]:
                print(f"{k}: {rows[-1].outcome}: {rows[-1].said}", flush=True)
    return rows, apart


def _known(path: Path) -> list[Row]:
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    cases = [Case(Convention(**line["case"].pop("convention")), **line["case"]) for line in lines]
    return [Row(case, line["outcome"], line["decided"], line["said"]) for case, line in zip(cases, lines, strict=True)]


def _remove(path: Path) -> None:
    for file in path.iterdir() if path.is_dir() else (path,):
        file.unlink()


def properties(row: Row) -> Iterator[str]:
    """Yields the kinds that a recording counts for."""
    convention = row.case.convention
    yield "all"
    yield f"times since {convention.point_times}"
    if row.case.beside != "nothing":
        yield f"{row.case.beside} {'with another clock' if row.case.late else 'with the same clock'}"
    if convention.bags > 1:
        yield "split"
    if convention.container != "bag":
        yield "ROS 2"
    if convention.bad_times:
        yield f"bad times {'above' if convention.bad_times > _MOST_BAD else 'below'} 5 %"


def run(config: RecordingsConfig) -> int:
    """Measures, prints, writes; 1 where a recording was wrong in silence."""
    if config.count < 1:
        raise BenchmarkError(f"count must be at least 1, got {config.count}")
    config.out.mkdir(parents=True, exist_ok=True)
    rows, apart = measure(config)
    counts = Counter((kind, row.outcome) for row in rows for kind in properties(row))
    kinds = sorted({kind for kind, _ in counts})
    print(markdown_table(("kind", *OUTCOMES), [(kind, *(str(counts[kind, o]) for o in OUTCOMES)) for kind in kinds]))
    decided = Counter((row.case.convention.point_times, row.decided) for row in rows)
    print(json.dumps({f"{true} taken for {taken}": n for (true, taken), n in sorted(decided.items())}, indent=1))
    print(
        f"bores of {len(apart)} built: {', '.join(f'{1e3 * value:.2f}' for value in apart)} mm RMS from the control's"
    )
    write_records(config.out / "records.json", records_of(config, rows, apart))
    return int(any(row.outcome == "wrong in silence" for row in rows))


def records_of(config: RecordingsConfig, rows: list[Row], apart: list[float]) -> list[Record]:
    """Return the counts by kind, those of what times were taken for, and the largest difference of a bore."""
    command = f"benchmarks.recordings --count {config.count} --seed {config.seed} --out out/recordings"
    further = {"n": config.count, "seed": config.seed, "split": f"one simulated drive of {config.length:g} m"}
    found = Counter((kind, row.outcome) for row in rows for kind in properties(row))
    ids = {f"{_id(kind)}/{_id(outcome)}": found[kind, outcome]
           for kind in dict.fromkeys(kind for kind, _ in found) for outcome in OUTCOMES}  # fmt: skip
    taken = Counter((row.case.convention.point_times, row.decided) for row in rows)
    true = dict.fromkeys(true for true, _ in taken)
    ids |= {f"taken/{_id(one)}/{_id(other)}": taken[one, other] for one in true for other in _DECIDED.values()}
    records = [measured(f"recordings/{id}", n, "", command, **further) for id, n in ids.items()]
    if apart:
        value = round(1e3 * max(apart), 2)
        records.append(measured("recordings/bore", value, "mm", command, **{**further, "n": len(apart)}))
    return records


def _id(words: str) -> str:
    return words.replace(",", "").replace("%", "percent").replace(" ", "-")


if __name__ == "__main__":
    sys.exit(run_main("recordings", RecordingsConfig, run, description=__doc__))
