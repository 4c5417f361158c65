"""One short drive in conventions drawn at random: built as it was, or refused for the true reason?

`python -m benchmarks.recordings --count 300 --out out/recordings` writes `records.json` and a row for each recording.
"""

import io
import json
import multiprocessing
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import yaml
from jaxtyping import Float, UInt64

from benchmarks.command import require_least, run_main
from benchmarks.records import Record, measured, write_records
from benchmarks.results import markdown_table
from scene.bore import Bore
from scene.build import judge, reconstruct
from scene.config import BuildConfig, ReconstructConfig
from scene.poses.calibration import load_calibration
from scene.poses.clocks import settle
from scene.poses.imu import find_inertial
from scene.poses.trajectory import Trajectory, load_tum, save_tum
from scene.progress import Stages
from scene.reading.formats import ReadingConfig
from scene.reading.recording import Recording
from scene.survey.bore import draw_bore
from scene.survey.carrier import IMUS, LIDARS, Carried, calibration, draw_walk, measure_prism
from scene.survey.cast import Caster, sweeps
from scene.survey.config import SensorErrors, SurveyConfig
from scene.survey.lidar import SCAN_PERIOD, VLP16_RINGS, Lidar, Sweep, avia, vlp16
from scene.survey.messages import EPOCH, Convention
from scene.survey.simulate import TRUTH_RATE, draw_imu_messages, make_device, write_recording
from scene.survey.write import write_tum
from scene.writing.track import lay_track

_EVERY = 6  # firings of the VLP-16 of which one is kept
_AVIA_RATE = 60_000  # points/s
_COMPARED = 12  # sweeps of a recording that are compared point by point
_CLOCK = 0.010  # s: error of a point's time or of a clock that counts as noise
_APART, _LONGER = 0.015, 0.10  # m: of two walls, RMS, and of two bores' lengths, that count as noise
_DROPPED = 0.001  # fraction of the good points that may be left out, as is said
_MOST_BAD = 0.05  # fraction of bad times that the reader states as its limit
_ODDS: dict[str, dict[Any, int]] = {  # of each value of a convention
    "point_times": {"driver": 3, "header": 5, "sweep": 4, "epoch": 4, "boot": 6, "constant": 1, "none": 1},
    "point_unit": {"s": 1, "ms": 1, "us": 1, "ns": 1},
    "point_type": {"f4": 1, "f8": 1, "u4": 1},
    "point_field": {"timestamp": 1, "time": 1, "t": 1, "offset_time": 1},
    "header_of": {"start": 1, "end": 1},
    "boot": {4.0: 1, 320.0: 1, 1500.0: 1, 30000.0: 1, 4e6: 1},
    "bad_times": {0.0: 4, 0.001: 1, 0.01: 1, 0.03: 1, 0.1: 1},
    "by_ring": {False: 1, True: 1},
    "empty": {"left out": 2, "zero": 1, "nan": 1},
    "chunks": {1: 7, 2: 1},
    "missing": {0.0: 3, 0.02: 1},
    "big_endian": {False: 3, True: 1},
    "container": {"bag": 2, "mcap": 1, "db3": 1},
    "bags": {1: 2, 2: 1, 3: 1},
}
Sensor = Literal["vlp16", "avia"]
Beside = Literal["trajectory", "IMU"]  # with positions of a prism, which fix the length
Outcome = Literal[
    "as control", "static, as said", "refused, true reason", "other, with a warning", "refused, other reason",
    "wrong in silence",
]  # fmt: skip
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
_DECIDED = {"after": "header", "same clock": "epoch", "other clock": "other clock", "static": "static", "": "refused"}


@dataclass(frozen=True)
class RecordingsConfig:
    """Writes one drive in many conventions and builds each."""

    count: int = 300  # Recordings.
    seed: int = 0  # Draws the drive and the conventions.
    length: float = 12.0  # Length of the bore, m.
    workers: int = 1  # Processes.
    out: Path = Path("out/recordings")  # Output folder.


@dataclass(frozen=True)
class Drive:
    """One drive of one LiDAR, to be written in any convention."""

    config: SurveyConfig
    sensor: Sensor
    lidar: Lidar
    carried: Carried
    sweeps: list[Sweep]
    poses: Trajectory  # True ones of the LiDAR
    mounts: Path  # Calibration
    prism: Path  # Positions of the prism on the rack, by the LiDAR's clock
    controls: dict[Beside, Bore] = field(default_factory=dict)  # Bores of the driver's own convention

    def index(self) -> tuple[UInt64[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return keys of all returns, sorted, and the time of each, s since 1970."""
        keys = np.concatenate([_keys(sweep.points[sweep.valid]) for sweep in self.sweeps])
        times = np.concatenate([EPOCH + 1e-9 * (sweep.begin + sweep.offset[sweep.valid]) for sweep in self.sweeps])
        order = np.argsort(keys)
        return keys[order], times[order]


@dataclass(frozen=True)
class Case:
    """One recording, and what is beside the LiDAR."""

    convention: Convention
    sensor: Sensor
    beside: Beside
    late: float  # Of its clock, s


@dataclass(frozen=True)
class Row:
    """Outcome of a recording."""

    case: Case
    outcome: Outcome
    decided: str  # What its times were taken for
    said: str  # Sentence printed, or the refusal
    apart: float = 0.0  # Of the walls from the control's, RMS, m


def drive_through(config: RecordingsConfig, folder: Path, sensor: Sensor) -> Drive:
    """Simulates the drive: a VLP-16 with fewer firings, or an Avia with fewer pulses."""
    survey = SurveyConfig(folder, length=max(config.length, 10.5), sensors=(sensor,), seed=config.seed)
    of_bore, of_walk, of_lidar = np.random.SeedSequence(config.seed).spawn(3)
    bore = draw_bore(of_bore, survey.length, survey.truth, survey.correlation, survey.tolerances)
    walk = draw_walk(np.random.default_rng(of_walk), bore, survey.speed, SCAN_PERIOD)
    carried, lidar = Carried(walk, LIDARS[sensor]), vlp16() if sensor == "vlp16" else avia(_AVIA_RATE)
    caster = Caster(bore.mesh(), lidar.range_max)
    seen = list(sweeps(np.random.default_rng(of_lidar), lidar, carried, caster, SensorErrors(), 1))
    if sensor == "vlp16":
        kept = np.flatnonzero(np.arange(len(lidar.offset)) // VLP16_RINGS % _EVERY == 0)
        seen = [sweep.pick(kept) for sweep in seen]
        lidar = replace(lidar, offset=lidar.offset[kept], line=lidar.line[kept])
    time = np.arange(round(walk.duration * TRUTH_RATE) + 1) / TRUTH_RATE
    poses = carried.poses(time)
    truth, mounts, prism = folder / f"{sensor}.tum", folder / f"{sensor}.yaml", folder / "prism.tum"
    write_tum(prism, *measure_prism(np.random.default_rng(config.seed), walk, survey.errors.prism_noise), None)
    write_tum(truth, time, poses.position, poses.quaternion)
    mounts.write_text(yaml.safe_dump(calibration(sensor)))
    return Drive(survey, sensor, lidar, carried, seen, load_tum(truth), mounts, prism)


def draw_case(rng: np.random.Generator) -> Case:
    """Draws a convention that a driver could have, and whose clock is beside it."""
    while True:
        values = {name: _draw(rng, odds) for name, odds in _ODDS.items()}
        sensor, beside = _draw(rng, {"vlp16": 3, "avia": 2}), _draw(rng, {"trajectory": 3, "IMU": 2})
        late = float(rng.uniform(-1.2, 1.2)) if rng.random() < 0.5 else 0.0
        late = -2e8 if beside == "IMU" and rng.random() < 0.1 else late
        convention = Convention(**values, imu_late=late if beside == "IMU" else 0.0)
        try:
            convention.check()
        except ValueError:
            continue
        if convention.point_times not in ("driver", "constant", "none") or convention.bad_times == 0.0:
            return Case(convention, sensor, beside, late)


def _draw(rng: np.random.Generator, odds: dict[Any, int]) -> Any:
    weights = np.array(list(odds.values()), float)
    return list(odds)[int(rng.choice(len(odds), p=weights / weights.sum()))]


def write_case(drive: Drive, case: Case, path: Path) -> Path:
    """Writes the drive in a convention; returns what a user would name."""
    config = replace(drive.config, convention=case.convention)
    device = replace(make_device(drive.sensor, config), lidar=drive.lidar)
    seeds = np.random.SeedSequence(1).spawn(len(IMUS[drive.sensor]))
    inertial = draw_imu_messages(seeds, drive.sensor, drive.carried, config)
    return write_recording(path, device, drive.sweeps, inertial, case.convention, len(drive.sweeps))[0]


def read_case(drive: Drive, case: Case, path: Path) -> Row:
    """Reads a recording as a build does, with `--clock auto`, and compares points, times and clocks with the truth."""
    try:
        with Recording(path) as recording:
            recording.peek()
            if case.beside == "trajectory":
                late = replace(drive.poses, times=drive.poses.times + case.late)
                lag = settle(recording, late, True)[0].offset
            else:
                inertial, mount = find_inertial(recording, load_calibration(drive.mounts))
                lag = settle(recording, inertial, True, mount.rotation)[0].offset if inertial and mount else None
            times = recording.convention
            error = time_error(drive, case, recording, case.late - (lag or 0.0))
            said = recording.facts["point_times"]
    except Exception as refused:  # a defect is a wrong reason, too
        fraction = case.convention.bad_times
        true = fraction > _MOST_BAD and "% of the points" in str(refused) and "none of their sweep" in str(refused)
        return Row(case, "refused, true reason" if true else "refused, other reason", "refused", repr(refused))
    said = f"{said}; clock {lag}, times off by {error:.4f} s"
    if times.kind == "static" and case.convention.point_times in ("constant", "none"):
        return Row(case, "static, as said", "static", said)
    return Row(case, "as control" if error <= _CLOCK else "wrong in silence", _DECIDED[times.kind], said)


def time_error(drive: Drive, case: Case, recording: Recording, late: float) -> float:
    """Return the largest error of a good point's time, s; infinite where points are missing, or are others.

    It counts against the clock beside the LiDAR, which is still `late`, s.
    """
    (keys, at), scans, convention = drive.index(), list(recording.scans()), case.convention
    expected = (1.0 - 2.0 * convention.bad_times - 2.0 * convention.missing - _DROPPED) * len(keys)
    if sum(len(scan.points) for scan in scans) < expected:
        return np.inf
    off = []
    for k in np.linspace(0, len(scans) - 1, _COMPARED).astype(int):
        own = _keys(scans[k].points)
        first, last = np.searchsorted(keys, own), np.searchsorted(keys, own, "right")
        if (first == last).any():
            return np.inf
        late_by = np.full(len(own), np.inf)
        for k_th in range(int((last - first).max(initial=0))):  # one and the same point may come back twice
            there = np.minimum(first + k_th, last - 1)
            late_by = np.minimum(late_by, np.abs(scans[k].stamp + scans[k].times - late - at[there]))
        off.append(late_by)
    # a bad time may look like one of the sweep, and the sweeps that are compared may have more of them than most
    return float(np.quantile(np.concatenate(off), 1.0 - 2.0 * convention.bad_times))


def _keys(points: np.ndarray) -> UInt64[np.ndarray, " n"]:
    """Return a number for each point, by the bits of its coordinates."""
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64).reshape(-1, 3)
    return (bits[:, 0] << np.uint64(32)) ^ (bits[:, 1] << np.uint64(16)) ^ (bits[:, 2] * np.uint64(0x9E3779B97F4A7C15))


def build_case(drive: Drive, case: Case, path: Path) -> tuple[Bore, str]:
    """Builds a recording as a user does, with `--clock auto`; returns the bore, and the warnings."""
    poses = path.with_suffix(".tum")
    save_tum(replace(drive.poses, times=drive.poses.times + case.late), poses)
    config = BuildConfig(reconstruct=ReconstructConfig(reading=ReadingConfig(clock="auto")))
    with Stages() as stages:
        given = (poses, None) if case.beside == "trajectory" else (None, drive.prism)
        mounts = load_calibration(drive.mounts)
        result = reconstruct(path, given[0], config.reconstruct, stages, given[1], mounts)
        judgement = judge(result, lay_track(result.bore, config.track, result.seen), config.judging)
    return result.bore, "; ".join(warning.text for warning in judgement.warnings)


def compare(one: Bore, other: Bore) -> tuple[float, float]:
    """Return by how much walls differ, RMS over the stations that both have, m, and by how much lengths do, m."""
    at = np.arange(1.0, min(one.length, other.length) - 1.0, 0.25)
    columns = [np.stack([np.interp(at, bore.station, column) for column in bore.radius.T]) for bore in (one, other)]
    return float(np.sqrt(np.mean((columns[0] - columns[1]) ** 2))), abs(one.length - other.length)


def judge_case(drive: Drive, case: Case, path: Path) -> Row:
    """Reads and builds a recording, and compares its bore with that of the driver's own convention."""
    row = read_case(drive, case, path)
    if row.outcome not in ("as control", "wrong in silence"):
        return row
    try:
        bore, warnings = build_case(drive, case, path)
    except Exception as refused:
        return replace(row, outcome="refused, other reason", said=f"{row.said}; {refused!r}")
    apart, longer = compare(bore, drive.controls[case.beside])
    said = f"{row.said}; {1e3 * apart:.1f} mm, {1e3 * longer:.0f} mm longer; {warnings}"
    same = row.outcome == "as control" and apart <= _APART and longer <= _LONGER
    warned = "clock" in warnings or "poses" in warnings
    outcome: Outcome = "as control" if same else "other, with a warning" if warned else "wrong in silence"
    return replace(row, outcome=outcome, said=said, apart=apart)


_drives: dict[str, Drive] = {}  # of the forked workers, by sensor


def _run(seed: int, folder: Path, k: int) -> Row:
    case = draw_case(np.random.default_rng([seed, k]))
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        path = write_case(_drives[case.sensor], case, folder / f"{k}.bag")
        row = judge_case(_drives[case.sensor], case, path)
    for file in path.iterdir() if path.is_dir() else (path,):
        file.unlink()
    return row


def _control(sensor: Sensor, beside: Beside, folder: Path) -> Bore:
    case = Case(Convention(), sensor, beside, 0.0)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        path = write_case(_drives[sensor], case, folder / f"{sensor}-{beside}.bag")
        return build_case(_drives[sensor], case, path)[0]


def measure(config: RecordingsConfig) -> list[Row]:
    """Writes, reads and builds all recordings; returns their rows."""
    rows = list[Row]()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        pairs: list[tuple[Sensor, Beside]] = [(s, b) for s in ("vlp16", "avia") for b in ("trajectory", "IMU")]
        _drives.update({sensor: drive_through(config, folder, sensor) for sensor, _ in pairs})
        context = multiprocessing.get_context("fork")  # a drive is no thing to be sent
        with ProcessPoolExecutor(config.workers, context) as pool:
            bores = pool.map(_control, *zip(*pairs, strict=True), [folder] * len(pairs))
            for (sensor, beside), bore in zip(pairs, bores, strict=True):
                _drives[sensor].controls[beside] = bore
        pool = stack.enter_context(ProcessPoolExecutor(config.workers, context))
        lines = stack.enter_context((config.out / "rows.jsonl").open("w"))
        for k, row in enumerate(pool.map(partial(_run, config.seed, folder), range(config.count))):
            rows.append(row)
            print(json.dumps({"number": k, **asdict(row)}), file=lines, flush=True)
            if row.outcome in OUTCOMES[3:]:
                print(f"{k}: {row.outcome}: {row.said}", flush=True)
    return rows


def properties(row: Row) -> Iterator[str]:
    """Yields the kinds that a recording counts for."""
    convention = row.case.convention
    yield "all"
    yield f"times since {convention.point_times}"
    yield f"{row.case.beside} {'with another clock' if row.case.late else 'with the same clock'}"
    yield row.case.sensor
    flags = {
        "split": convention.bags > 1, "ROS 2": convention.container != "bag", "pieces": convention.chunks > 1,
        "empty beams kept": convention.empty != "left out", "messages missing": convention.missing > 0.0,
        f"bad times {'above' if convention.bad_times > _MOST_BAD else 'below'} 5 %": convention.bad_times > 0.0,
    }  # fmt: skip
    yield from (name for name, there in flags.items() if there)


def run(config: RecordingsConfig) -> int:
    """Measures, prints, writes; 1 where a recording was wrong in silence."""
    require_least(config, count=1, workers=1)
    config.out.mkdir(parents=True, exist_ok=True)
    rows = measure(config)
    counts = Counter((kind, row.outcome) for row in rows for kind in properties(row))
    kinds = sorted({kind for kind, _ in counts})
    print(markdown_table(("kind", *OUTCOMES), [(kind, *(str(counts[kind, o]) for o in OUTCOMES)) for kind in kinds]))
    write_records(config.out / "records.json", records_of(config, rows))
    return int(any(row.outcome == "wrong in silence" for row in rows))


def records_of(config: RecordingsConfig, rows: list[Row]) -> list[Record]:
    """Return the counts by kind, those of what times were taken for, and the differences of the bores."""
    command = f"benchmarks.recordings --count {config.count} --seed {config.seed} --out out/recordings"
    further = {"n": config.count, "seed": config.seed, "split": f"a VLP-16 and an Avia in {config.length:g} m"}
    found = Counter((kind, row.outcome) for row in rows for kind in properties(row))
    ids = {f"{_id(kind)}/{_id(outcome)}": found[kind, outcome]
           for kind in dict.fromkeys(kind for kind, _ in found) for outcome in OUTCOMES}  # fmt: skip
    taken = Counter((row.case.convention.point_times, row.decided) for row in rows)
    true = dict.fromkeys(true for true, _ in taken)
    ids |= {f"taken/{_id(one)}/{_id(other)}": taken[one, other] for one in true for other in _DECIDED.values()}
    records = [measured(f"recordings/{id}", n, "", command, **further) for id, n in ids.items()]
    apart = [1e3 * row.apart for row in rows if row.outcome == "as control"]
    for name, fraction in (("median", 0.5), ("largest", 1.0)) if apart else ():
        value = round(float(np.quantile(apart, fraction)), 2)
        records.append(measured(f"recordings/bore-{name}", value, "mm", command, **{**further, "n": len(apart)}))
    return records


def _id(words: str) -> str:
    return words.replace(",", "").replace("%", "percent").replace(" ", "-")


if __name__ == "__main__":
    sys.exit(run_main("recordings", RecordingsConfig, run, description=__doc__))
