"""Ready sets of recordings by one command: every course of the dial, its truth apart, resumable."""

import hashlib
import json
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.command import BenchmarkError, require_least
from benchmarks.results import write_file
from benchmarks.slam.arena.bags import FormatName
from benchmarks.slam.arena.drives import CARRIERS
from benchmarks.slam.arena.record import (
    Course,
    Scene,
    SensorName,
    draw_scene,
    write_recording,
    write_truth,
)
from benchmarks.slam.arena.walls import WALLS, WallName
from benchmarks.slam.reading import INDEX, RECORDINGS, TRUTH

SCHEMA = "subterra.arena/1"
_DIAL = tuple(Course(f"walls-{name}", name) for name in WALLS)
_BY_BEAMS: tuple[tuple[int, SensorName], ...] = ((6, "avia"), (32, "os1-32"), (64, "os1-64"))
_SENSORS = tuple(Course(f"beams-{beams:02d}", "furnished", sensor) for beams, sensor in _BY_BEAMS)
_DUST = (Course("dust-half", "furnished", dust=0.1), Course("dust-lock", "furnished", dust=1.0))
_MOTIONS = tuple(Course(f"motion-{name}", "furnished", motion=name) for name in CARRIERS if name != "trolley")
_SMOOTH = tuple(Course(f"texture-smooth-{dial}", "smooth", texture=0.01 * dial) for dial in (25, 50, 100))
_ROUGH: tuple[WallName, ...] = ("joints", "sprayed")
_TEXTURES = (*_SMOOTH, *(Course(f"texture-{name}-100", name, texture=1.0) for name in _ROUGH))
_DOPPLER = (Course("doppler-smooth", "smooth", doppler=True),)
COURSES: tuple[Course, ...] = (*_DIAL, *_SENSORS, *_DUST, *_MOTIONS, *_TEXTURES, *_DOPPLER)


@dataclass(frozen=True)
class ArenaConfig:
    """Records the arena: drives for LiDAR-inertial programs, from smooth walls to rough ones.

    Example: python -m benchmarks.slam arena --jobs 2 --out out/arena
    """

    out: Path  # Folder of the set: `recordings/` to hand out, `truth/` to keep.
    # Names of the recordings, as `walls-smooth`; by default all.
    courses: tuple[str, ...] = tuple(one.name for one in COURSES)
    formats: tuple[FormatName, ...] = ("mcap",)  # `mcap` for ROS 2, `bag` for ROS 1.
    distance: float = 45.0  # Length of each drive, m.
    seed: int = 0  # Draws walls, drives and noise.
    # Number from which they are drawn instead, so that nobody else can make the truth. It is kept with the truth only.
    secret: int | None = None
    jobs: int = 1  # Recordings made at a time.


def plan_arena(config: ArenaConfig) -> list[Course]:
    """Returns the courses of a set.

    Raises:
        BenchmarkError: There is no such course or format, or a number is out of range.
    """
    known = {one.name: one for one in COURSES}
    for name in config.courses:
        if name not in known:
            raise BenchmarkError(f"no course {name!r}; there are {', '.join(known)}")
    if not config.courses or not config.formats:
        raise BenchmarkError("nothing to record: courses and formats must name at least one")
    if not 5.0 <= config.distance <= 500.0:
        raise BenchmarkError(f"distance must lie between 5 and 500 m, got {config.distance:g}")
    require_least(config, seed=0, jobs=1, **({} if config.secret is None else {"secret": 0}))
    return [replace(known[name], distance=config.distance) for name in dict.fromkeys(config.courses)]


def course_seed(config: ArenaConfig, course: Course) -> np.random.SeedSequence:
    """Returns the seed of a course; with a secret it cannot be computed without it."""
    origin = f"seed {config.seed}" if config.secret is None else f"secret {config.secret}"
    digest = hashlib.sha256(f"{SCHEMA} {origin} {course.name}".encode()).digest()
    # The dial turns one thing at a time: walls, drives and noise of one seed differ by nothing else.
    shared = hashlib.sha256(f"{SCHEMA} {origin}".encode()).digest()
    return np.random.SeedSequence(int.from_bytes((shared if config.secret is None else digest)[:8], "little"))


def make_arena(config: ArenaConfig) -> Iterator[tuple[str, bool]]:
    """Records what is missing; yields each name and whether it was there already.

    Raises:
        BenchmarkError: The folder was recorded with other settings.
        SubterraError: The folder cannot be written.
    """
    plan = plan_arena(config)
    settings = {"schema": SCHEMA, "distance": config.distance, "formats": config.formats, "seed": config.seed}
    kept, content = config.out / TRUTH / INDEX, json.dumps(settings | {"secret": config.secret}, indent=1)
    if kept.is_file() and kept.read_text() != content:
        raise BenchmarkError(f"{config.out}: was recorded with other settings; choose another folder")
    write_file(kept, content.encode())
    missing = [one for one in plan if not (config.out / RECORDINGS / one.name).is_dir()]
    yield from ((one.name, True) for one in plan if one not in missing)
    for name in _record_all(config, missing):
        yield name, False
    public = dict(settings)
    if config.secret is not None:
        public.pop("seed")
    courses = [{**asdict(one), "provenance": "simulated"} for one in plan]
    write_file(config.out / INDEX, (json.dumps(public | {"recordings": courses}, indent=1) + "\n").encode())


def _record_all(config: ArenaConfig, courses: list[Course]) -> Iterator[str]:
    if config.jobs == 1:
        for one in courses:
            yield _record(config, one)
        return
    with ProcessPoolExecutor(config.jobs, mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(_record, config, one) for one in courses]):
            yield future.result()


def _record(config: ArenaConfig, course: Course) -> str:
    """Makes one recording under a temporary name and renames it when it is whole."""
    part = config.out / f".{course.name}.part"
    shutil.rmtree(part, ignore_errors=True)
    scene = draw_scene(course, course_seed(config, course))
    total, shown = scene.drive.duration, -1
    for message in write_recording(scene, part, config.formats):
        fraction = int(10.0 * 1e-9 * message.time / total)
        if fraction > shown and sys.stderr.isatty():
            shown = fraction
            print(f"{course.name}: {10 * fraction} %", end="\r", file=sys.stderr)
    write_truth(scene, config.out / TRUTH / course.name)
    (config.out / RECORDINGS).mkdir(exist_ok=True)
    part.rename(config.out / RECORDINGS / course.name)
    return course.name


def redraw(folder: Path, name: str) -> Scene:
    """Draws the scene of a recording again from the settings beside its truth.

    Args:
        folder: The set.
        name: The recording.

    Raises:
        BenchmarkError: The set has no truth of the recording.
    """
    try:
        settings = json.loads((folder / TRUTH / INDEX).read_text())
        facts = json.loads((folder / TRUTH / name / "course.json").read_text())
    except (OSError, ValueError) as error:
        raise BenchmarkError(f"{folder}: holds no truth of {name}, from which it could be drawn again") from error
    course = Course(**{field.name: facts[field.name] for field in fields(Course) if field.name in facts})
    config = replace(ArenaConfig(folder), seed=settings["seed"], secret=settings["secret"])
    return draw_scene(course, course_seed(config, course))
