"""The arena's board: every program on every recording of some sets, each in a process of its own, scored."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.command import BenchmarkError, require_least
from benchmarks.results import environment_facts, write_file
from benchmarks.slam.arena.record import Scene, face_of
from benchmarks.slam.arena.sets import redraw
from benchmarks.slam.programs import DOPPLER, FURTHER, PROGRAMS, WHEELS, find_program
from benchmarks.slam.reading import ODOMETRY, TRUTH, TRUTH_FILE, check_recording, measures_speed, recordings_in
from benchmarks.slam.score import LEAST_COVERED, score_files
from scene.survey.carrier import rotate
from scene.survey.cast import ALBEDO, REFLECTIVITY_NOISE, Caster, Face, Hits, draw_returns, noise_sigma
from scene.survey.config import SensorErrors
from subterra_jax.evaluation.localisability import LEAST_SLOPE, PLACES, fit_slopes
from subterra_jax.host.files import replace_file

SCHEMA = "subterra.arena-board/2"
_ALONE = "import sys; from benchmarks.slam.programs import main; sys.exit(main(sys.argv[1:]))"
_SAYS = '{"poses"'  # beginning of the line in which the process reports
_KEPT = ("distance", "covered", "drift", "along_final", "along_rms", "across_rms", "up_rms", "reach")


@dataclass(frozen=True)
class Case:
    """One program on one recording."""

    program: str  # Name of the program
    recording: Path  # Folder of the recording
    place: Path  # Folder of the poses and facts

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def facts(self) -> Path:
        """File of what is known of the run."""
        return self.place / f"{self.name}.json"

    @property
    def poses(self) -> Path:
        """File of the estimated poses; missing where the program failed."""
        return self.place / f"{self.name}.tum"

    @property
    def truth(self) -> Path:
        """File of the true poses."""
        return self.recording.parent.parent / TRUTH / self.name / TRUTH_FILE


def run_case(case: Case, limit: float) -> dict[str, Any]:
    """Runs a case unless its facts are there, for `limit` s at most.

    Returns:
        `seconds` that the program took, `share` of the recording's duration, `poses`, or `failed` with the reason;
        `version`, `date` and `machine`.
    """
    if case.facts.is_file():
        return json.loads(case.facts.read_text())
    case.place.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {}
    if case.program == WHEELS:
        with replace_file(case.poses) as fresh:
            shutil.copyfile(case.recording / "recording" / ODOMETRY, fresh)
    else:
        result = _run_alone(case, limit)
    facts = environment_facts()
    result |= {"version": find_program(case.program), "date": facts["date"]}
    result["machine"] = f"{facts['cpu_cores']} cores, {facts['processor']}"
    write_file(case.facts, (json.dumps(result) + "\n").encode())
    return result


def _run_alone(case: Case, limit: float) -> dict[str, Any]:
    """Runs a program in a process of its own: one that crashes takes no other with it."""
    words = [sys.executable, "-c", _ALONE, case.program]
    paths = [str(case.recording.resolve()), str(case.poses.resolve())]
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    try:
        done = subprocess.run([*words, *paths], capture_output=True, text=True, timeout=limit, env=environment)
    except subprocess.TimeoutExpired:
        return {"failed": f"did not finish within {limit:g} s"}
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"ended with status {done.returncode}"]
        return {"failed": last[0] if done.returncode > 0 else f"crashed with signal {-done.returncode}: {last[0]}"}
    said = [line for line in done.stdout.splitlines() if line.startswith(_SAYS)]  # libraries print too
    return json.loads(said[-1])


def describe(result: dict[str, Any]) -> str:
    """Returns a line about a run."""
    if "failed" in result:
        return f"failed: {result['failed']}"
    if "poses" not in result:
        return "copied"
    return f"{result['poses']} poses in {result['seconds']:.0f} s, {100.0 * result['share']:.0f} % of real time"


@dataclass(frozen=True)
class BoardConfig:
    """Runs and scores every program on sets of the arena.

    Example: python -m benchmarks.slam board --sets out/arena --out out/slam --jobs 2
    """

    out: Path  # Folder for poses, `board.json`, `board.md`, `board.png` and `records.json`.
    sets: tuple[Path, ...] = ()  # Sets of the arena with their truth, one for each seed.
    # Programs to run; by default all of the extra `slam`, ours and the odometer.
    programs: tuple[str, ...] = tuple(name for name in (WHEELS, *PROGRAMS) if name not in FURTHER)
    jobs: int = 1  # Programs run at a time.
    limit: float = 1800.0  # Time after which a program counts as failed on a recording, s.


def plan_board(config: BoardConfig) -> list[Case]:
    """Returns the cases of a board.

    Raises:
        BenchmarkError: A program is unknown or not installed, a set holds no recordings or no truth, a bag that is
            to be run on is damaged, or two sets have one name.
    """
    require_least(config, jobs=1)
    if not config.programs or not config.sets:
        raise BenchmarkError("sets and programs must name at least one")
    if len({folder.name for folder in config.sets}) < len(config.sets):
        raise BenchmarkError("sets must differ in the last part of their names")
    for name in config.programs:
        find_program(name)
    cases = []
    for folder in config.sets:
        for recording in recordings_in(folder):
            place = config.out / "poses" / folder.name
            some = config.programs if measures_speed(recording) else [one for one in config.programs if one != DOPPLER]
            cases += [Case(program, recording, place / program) for program in some]
            if cases and not cases[-1].truth.is_file():
                raise BenchmarkError(f"{folder}: holds no truth of {recording.name}")
    for recording in {one.recording for one in cases if not one.facts.is_file()}:
        check_recording(recording)  # a damaged bag is no failure of a program
    return cases


def make_board(config: BoardConfig) -> Iterator[tuple[str, str]]:
    """Runs and scores what is missing; yields each case and its result; writes `board.json` at the end.

    Raises:
        BenchmarkError: See `plan_board`.
    """
    cases = plan_board(config)
    with ThreadPoolExecutor(config.jobs) as pool:
        futures = {pool.submit(run_case, one, config.limit): one for one in cases}
        for future in as_completed(futures):
            one = futures[future]
            yield f"{one.place.parent.name} {one.name} {one.program}", describe(future.result())
    floors = []
    for floor in _find_floors(config):
        floors.append(floor)
        yield f"{floor['set']} {floor['recording']} floor", f"{floor['drift']:.4f} m per 100 m"
    rows = [read_case(one) for one in cases]
    content = {"schema": SCHEMA, **environment_facts(), "rows": rows, "floors": floors}
    write_file(config.out / "board.json", (json.dumps(content, indent=1) + "\n").encode())


def read_case(case: Case) -> dict[str, Any]:
    """Returns the facts and the score of a case that was run."""
    labels = {"set": case.place.parent.name, "recording": case.name, "program": case.program}
    facts = labels | run_case(case, 0.0)
    if "failed" in facts:
        return facts
    try:
        score, _ = score_files(case.poses, case.truth)
    except BenchmarkError as error:
        return facts | {"failed": str(error)}
    if score.covered < LEAST_COVERED:
        facts["failed"] = f"gives poses over {100.0 * score.covered:.0f} % of the recording only"
    return facts | {name: getattr(score, name) for name in _KEPT}


def _find_floors(config: BoardConfig) -> Iterator[dict[str, Any]]:
    cases = [(folder, recording.name, config.out / "floors" / folder.name / f"{recording.name}.json")
             for folder in config.sets for recording in recordings_in(folder)]  # fmt: skip
    if config.jobs == 1 or all(kept.is_file() for *_, kept in cases):
        yield from (_floor(*one) for one in cases)
        return
    with ProcessPoolExecutor(config.jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_floor, *zip(*cases, strict=True))


def _floor(folder: Path, name: str, kept: Path) -> dict[str, Any]:
    """Returns the floor of a recording, drawn again from the settings beside its truth unless it is kept."""
    if not kept.is_file():
        write_file(kept, (json.dumps(find_floor(redraw(folder, name))._asdict()) + "\n").encode())
    return {"set": folder.name, "recording": name, **json.loads(kept.read_text())}


# Floor of the axial drift: what ranges and brightness of a drive could tell about the way, whatever program reads them.
#
# A beam's slope over the station is that of the best line through its ranges from stations about the true one
# (statistical linearisation); what the line leaves over counts as noise.
# One sweep against a perfect map knows the station to the Cramér–Rao bound σ₁. A program without a map ties each view
# length ℓ of wall to the next, with every sweep that sees both: over a way d its drift is at least
# σ₁ · sqrt(2 / n) · sqrt(d / ℓ), with n sweeps to a view length.
#
# Slopes below `LEAST_SLOPE` count as none: no program knows a wall to the millimetre before it has driven past.
_SWEEPS = 12  # sweeps of a drive that are looked at


class Floor(NamedTuple):
    """Bounds of one drive."""

    sweep: float  # Cramér–Rao bound of the station from one sweep and a perfect map, median over the drive, m
    view: float  # Length of bore that a sweep shows, m
    drift: float  # Floor of the axial drift per 100 m, m


def find_floor(scene: Scene) -> Floor:
    """Returns the floor of a drive, its dust left out."""
    drive, lidar = scene.drive, scene.sensor.lidar
    start, _, _, end = drive.knots
    caster = Caster(drive.bore.mesh(), lidar.range_max)
    rng = np.random.default_rng(0)
    rays = lidar.directions(1e-9 * lidar.offset, np.zeros(2))
    pairs = [_sweep_bound(rng, scene, caster, rays, at) for at in np.linspace(start + 2.0, end, _SWEEPS)]
    sweep, view = (float(np.median(values)) for values in zip(*pairs, strict=True))
    sweeps = max(1.0, 10.0 * view / drive.carrier.speed)
    return Floor(sweep, view, sweep * np.sqrt(2.0 / sweeps) * np.sqrt(100.0 / view))


def _brightness(face: Face, station: float, origin: np.ndarray, heading: np.ndarray, hits: Hits) -> np.ndarray:
    """Returns the reflectivity that each beam would report without noise, 1."""
    ends = origin + np.where(np.isfinite(hits.distance), hits.distance, 0.0)[:, None] * heading
    return face(station, ends, hits.part) * ALBEDO[hits.part] * hits.cosine


def _sweep_bound(
    rng: np.random.Generator, scene: Scene, caster: Caster, rays: Float[np.ndarray, "n 3"], time: float
) -> tuple[float, float]:
    """Returns the bound of the station of one sweep, m, and the length of bore that it shows, m."""
    at = np.array([time])
    poses = scene.drive.poses(at)
    tangent = scene.drive.bore.alignment.frames(scene.drive.station(at)).tangent[0]
    heading = rotate(np.repeat(poses.quaternion, len(rays), axis=0), rays)
    loaded = caster.load(float(scene.drive.station(at)[0]), poses.position[0])
    casts = [loaded.cast(np.repeat(poses.position + shift * tangent, len(rays), axis=0), heading)
             for shift in PLACES]  # fmt: skip
    ranges = np.stack([one.distance for one in casts]).astype(np.float64)
    hits = casts[len(casts) // 2]
    seen = draw_returns(rng, scene.sensor.lidar, SensorErrors(), hits) & np.isfinite(ranges).all(axis=0)
    slope, left = fit_slopes(ranges[:, seen])
    noise = noise_sigma(SensorErrors(), hits.distance[seen], hits.cosine[seen])
    information = np.sum(np.where(abs(slope) < LEAST_SLOPE, 0.0, slope**2 / (noise**2 + left)))
    if (face := face_of(scene)) is not None:
        at_once = zip(PLACES, casts, strict=True)
        station = float(scene.drive.station(at)[0])
        shown = np.stack([_brightness(face, station, poses.position + x * tangent, heading, one) for x, one in at_once])
        slope, left = fit_slopes(shown[:, seen])
        information += np.sum(slope**2 / (REFLECTIVITY_NOISE**2 * shown.mean(axis=0)[seen] ** 2 + left))
    along = (heading[seen] @ tangent) * hits.distance[seen]
    view = float(np.ptp(np.quantile(along, [0.05, 0.95])))
    return float(1.0 / np.sqrt(max(information, 1e-12))), view
