"""Ready sets of recordings by one command: every course of the dial, its truth apart, resumable."""

import hashlib
import json
import shutil
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.command import BenchmarkError
from benchmarks.results import version, write_file
from benchmarks.slam.arena.bags import FormatName
from benchmarks.slam.arena.drives import CARRIERS
from benchmarks.slam.arena.record import (
    REST,
    Course,
    Scene,
    SensorName,
    draw_scene,
    make_sensor,
    write_recording,
    write_truth,
)
from benchmarks.slam.arena.walls import WALLS, WallName
from benchmarks.slam.reading import INDEX, RECORDINGS, TRUTH
from scene.survey.carrier import ACCEL_BIAS, GYRO_BIAS

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
    """Settings of a set."""

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
    for name, least in (("seed", 0), ("jobs", 1), ("secret", 0)):
        value = getattr(config, name)
        if value is not None and value < least:
            raise BenchmarkError(f"{name} must be at least {least}, got {value}")
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
    describe_set(config.out, plan)


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
        share = int(10.0 * 1e-9 * message.time / total)
        if share > shown and sys.stderr.isatty():
            shown = share
            print(f"{course.name}: {10 * share} %", end="\r", file=sys.stderr)
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


# A set's `croissant.json` and datasheet. Source of the vocabulary: Croissant 1.0,
# https://docs.mlcommons.org/croissant/docs/croissant-spec-1.0.html.
CROISSANT, DATASHEET = "croissant.json", "datasheet.md"
_LICENCE = "https://spdx.org/licenses/Apache-2.0.html"
_ENCODINGS = {".mcap": "application/x-mcap", ".bag": "application/x-rosbag", ".yaml": "application/yaml",
              ".tum": "text/plain"}  # fmt: skip
_CONTEXT = {
    "@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/", "citeAs": "cr:citeAs", "column": "cr:column", "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"}, "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"}, "extract": "cr:extract", "field": "cr:field",
    "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject", "fileSet": "cr:fileSet", "format": "cr:format",
    "equivalentProperty": "cr:equivalentProperty", "samplingRate": "cr:samplingRate",
    "includes": "cr:includes", "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath", "key": "cr:key",
    "md5": "cr:md5", "parentField": "cr:parentField", "path": "cr:path", "recordSet": "cr:recordSet",
    "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated", "replace": "cr:replace",
    "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField", "transform": "cr:transform",
}  # fmt: skip
_FIELDS = {
    "name": ("sc:Text", "Name of the recording and of its folder"),
    "walls": ("sc:Text", "Position on the dial of degeneracy"),
    "sensor": ("sc:Text", "LiDAR"),
    "motion": ("sc:Text", "Way of carrying it"),
    "dust": ("sc:Float", "Density of the dust that moves with it; 0 is none, 1 full"),
    "distance": ("sc:Float", "Length of the way, m"),
    "texture": ("sc:Float", "Brightness of the lining; from 0, all alike, to 1"),
    "doppler": ("sc:Boolean", "The LiDAR measures the speed of each range too"),
}


def describe_set(folder: Path, courses: Iterable[Course]) -> None:
    """Writes `croissant.json` and `datasheet.md` of a set whose recordings are there."""
    courses = list(courses)
    content = as_croissant(folder, courses)
    write_file(folder / CROISSANT, (json.dumps(content, indent=1) + "\n").encode())
    write_file(folder / DATASHEET, as_datasheet(folder, courses).encode())


def as_croissant(folder: Path, courses: list[Course]) -> dict[str, Any]:
    """Returns the metadata of a set: every file with its SHA-256, and the courses as records."""
    files = [path for one in courses for path in sorted((folder / RECORDINGS / one.name).rglob("*")) if path.is_file()]
    fields = [
        {"@type": "cr:Field", "@id": f"courses/{name}", "name": name, "description": text, "dataType": kind}
        for name, (kind, text) in _FIELDS.items()
    ]
    rows = [{f"courses/{name}": getattr(one, name) for name in _FIELDS} for one in courses]
    return {
        "@context": _CONTEXT, "@type": "sc:Dataset", "name": "subterra-arena",
        "conformsTo": "http://mlcommons.org/croissant/1.0", "license": _LICENCE,
        "version": version("subterra-jax") or "0.0.0",
        "description": _SUMMARY.format(n=len(courses)),
        "keywords": ["simulated", "LiDAR", "IMU", "odometry", "SLAM", "tunnel", "GNSS-denied"],
        "rai:dataCollection": "Simulated: rays cast in drawn tunnels. No place and no person was recorded.",
        "citeAs": "Subterra: An Open-Source Validated Benchmark for GNSS-Denied Tunnel Navigation",
        "isLiveDataset": False, "distribution": [_file(folder, path) for path in files],
        "recordSet": [{
            "@type": "cr:RecordSet", "@id": "courses", "name": "courses", "key": {"@id": "courses/name"},
            "description": "One row for each recording.", "field": fields, "data": rows,
        }],
    }  # fmt: skip


_SUMMARY = (
    "{n} simulated drives through straight tunnels, recorded as ROS bags for LiDAR-inertial programs: sweeps with the "
    "time of every point, an IMU at 200 Hz, wheel odometry, extrinsics. The true poses are kept apart."
)


def _file(folder: Path, path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    name = path.relative_to(folder).as_posix()
    return {
        "@type": "cr:FileObject", "@id": name, "name": name, "contentUrl": name, "sha256": digest,
        "contentSize": f"{path.stat().st_size} B",
        "encodingFormat": _ENCODINGS.get(path.suffix, "application/octet-stream"),
    }  # fmt: skip


def as_datasheet(folder: Path, courses: list[Course]) -> str:
    """Returns the datasheet of a set.

    Source of its questions: Gebru et al. 2021, Datasheets for Datasets.
    """
    rows = [
        f"| {one.name} | {one.walls} | {one.sensor}, {make_sensor(one.sensor).beams} lines | {one.motion} | "
        f"{one.dust:g} | {one.distance:g} | {one.texture:g} | {'yes' if one.doppler else 'no'} |"
        for one in courses
    ]
    imu = yaml.safe_load((folder / RECORDINGS / courses[0].name / "calibration.yaml").read_text())["imu"]
    return _SHEET.format(
        rows="\n".join(rows), rest=REST, rate=imu["rate"], accel=imu["accel_noise_density"],
        gyro=imu["gyro_noise_density"], accel_walk=imu["accel_random_walk"], gyro_walk=imu["gyro_random_walk"],
        accel_bias=ACCEL_BIAS, gyro_bias=GYRO_BIAS,
    )  # fmt: skip


_SHEET = """# Datasheet of this set

**Everything here is simulated.** No place and no person was recorded.

## Why it was made
To compare LiDAR and LiDAR-inertial odometry along tunnels, from walls that show no motion to walls that show all of it.

## What it holds
| recording | walls | LiDAR | carried by | dust | way, m | texture | Doppler |
|---|---|---|---|---|---|---|---|
{rows}

Each folder of `recordings/` holds a ROS bag (sweeps, IMU, odometry, `/tf_static`), the odometry as TUM, and
`calibration.yaml` with topics, extrinsics and noise. Each recording begins with a rest of {rest:g} s. `croissant.json`
has the SHA-256 of every file. The true poses are not part of what is handed out.

## How it was made
Rays are cast in tunnels drawn at random, each from the pose at its own time. Range noise, lost echoes, mixed pixels
and reflectivity are models. The IMU has {rate:g} Hz, noise of {accel:.2g} m/s²/√Hz and {gyro:.2g} rad/s/√Hz, random
walks of {accel_walk:.2g} m/s³/√Hz and {gyro_walk:.2g} rad/s²/√Hz, and biases of {accel_bias:.2g} m/s² and
{gyro_bias:.2g} rad/s (one standard deviation). The wheel odometry has one scale error a robot, 2.2 % long or short.

## What it is not
The bores are straight and level, and have one section. Wheels do not slip. Nothing moves but the sensor and its dust.
Sizes of roughness, furniture and dust are assumptions; a program's rank here need not be its rank in a real tunnel.

## Use, licence, upkeep
Apache-2.0. The same command with the same seed makes the same set again; sets made with a secret cannot be made again
without it. Errors found in a set are mended in the program that makes it.
"""
