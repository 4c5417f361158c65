"""A set's `croissant.json` and datasheet: who made it, how, with which noise, under which licence, file by file.

Source of the vocabulary: Croissant 1.0, https://docs.mlcommons.org/croissant/docs/croissant-spec-1.0.html.
"""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from benchmarks.results import version, write_file
from benchmarks.slam.arena.record import REST, Course, make_sensor
from benchmarks.slam.reading import RECORDINGS
from scene.survey.carrier import ACCEL_BIAS, GYRO_BIAS

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
        f"{one.dust:g} | {one.distance:g} |"
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
| recording | walls | LiDAR | carried by | dust | way, m |
|---|---|---|---|---|---|
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
