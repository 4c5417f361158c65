"""Well-formed, unusual inputs by the command: each is built as it was, or refused for its true reason."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.recordings import Case, Drive, RecordingsConfig, drive_through, write_case
from scene.build import main
from scene.survey.messages import Convention
from tests.scene.clouds import curved_d_bore
from tests.scene.conventions import sweeps
from tests.scene.fits import keep
from tests.scene.messages import PLAIN, pointcloud2, write_bag1
from tests.scene.test_odd_inputs import WKT, ptx, write_las

pytestmark = pytest.mark.usefixtures("silent")
POINTS = curved_d_bore(length=12.0, per_metre=2000, offset=(1.0, 2.0, 0.5)).points
TEXT = "".join("{:.4f} {:.4f} {:.4f} 9 1 2 3\n".format(*row) for row in POINTS)
SOUND = {"clock_doubt": None, "pose_doubt": None}


Write = Callable[[Path, Drive | None], Path]


@dataclass(frozen=True)
class Row:
    """Row of the table: files of a user, words of the command, and its answer."""

    write: Write
    said: str  # part of what is printed
    words: str = "--trajectory {0}/vlp16.tum"
    status: int = 0
    facts: dict[str, Any] = field(default_factory=dict)  # of the manifest


def drive(**how: Any) -> Write:
    def write(folder: Path, one: Drive | None) -> Path:
        return write_case(one, Case(Convention(**how), "vlp16", "trajectory", 0.0), folder / "a.bag")

    return write


def boot(unit: str, since: float) -> Write:
    return drive(point_times="boot", point_unit=unit, boot=since, header_of="end")


def write_e57(folder: Path, _: Drive | None) -> Path:
    pye57, rows = pytest.importorskip("pye57"), POINTS.copy()
    rows[::2] = 0.0
    with pye57.E57(str(folder / "a.e57"), mode="w") as file:
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), rows.T.copy(), strict=True))
        file.write_scan_raw(columns, translation=np.array([100.0, 0.0, 0.0]))
    return folder / "a.e57"


def write_laz(folder: Path, _: Drive | None) -> Path:
    """A tenth of the points in a film 0.3 m before the walls, marked as withheld, and two of noise."""
    film = (POINTS[::10] - POINTS.mean(axis=0)) * [1.0, 1.0, 0.9] + POINTS.mean(axis=0)
    return write_las(folder / "a.laz", np.concatenate([POINTS, film]), range(len(POINTS), len(POINTS) + len(film)),
                     (3, 4), WKT)  # fmt: skip


def file(name: str, content: bytes) -> Write:
    def write(folder: Path, _: Drive | None) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return write


def small(topics: tuple[str, ...], **times: float) -> Write:
    """A few sweeps on each topic, with times of a scale."""

    def write(folder: Path, _: Drive | None) -> Path:
        fields = [*PLAIN, ("time", "f4", 12)] if times else PLAIN
        rows = [(at, pointcloud2(at, fields, 16, dict(zip("xyz", xyz.T, strict=True))
                                 | {name: scale * since for name, scale in times.items()}))
                for at, xyz, since in sweeps(12)]  # fmt: skip
        return write_bag1(folder / "a.bag", dict.fromkeys(topics, rows))

    return write


CONTROL = "--control {0}/prism.tum --calibration {0}/vlp16.yaml"
OTHER = "by another clock, {}; sweeps of 0."
ROWS = {
    "ns since boot in floats": Row(boot("ns", 320.0), OTHER.format("ns"), facts=SOUND),
    "s since boot": Row(boot("s", 320.0), OTHER.format("s"), facts=SOUND | {"quaternions": "xyzw (by default)"}),
    "times that underflow": Row(
        drive(point_times="header", point_unit="ns", point_type="u4", bad_times=0.001),
        "points without a time of their sweep", facts=SOUND),
    "an IMU 0.1 s late": Row(drive(imu_late=0.1), "the clock of the IMU /imu/data is 0.1", CONTROL, 2),
    "a prism years late, set right": Row(
        drive(), "", CONTROL.replace("prism", "late") + " --clock auto",
        facts=SOUND | {"control_clock_offset": pytest.approx(2e8, abs=0.02), "control_clock_corrected": True}),
    "poses of another drive": Row(
        drive(), "are not those of the LiDAR", "--trajectory {0}/other/vlp16.tum", 2),
    "a folder of bags": Row(drive(bags=3), "s before the stamp (its end)", facts=SOUND | {"bags": 3}),
    "gzip": Row(file("a.bag.gz", b"\x1f\x8b"), "is compressed; decompress it first: gzip -d a.bag.gz", "", 2),
    "zstd": Row(file("a.mcap.zst", b"\x28\xb5\x2f\xfd"), "decompress it first: zstd -d a.mcap.zst", "", 2),
    "xz": Row(file("a.laz.xz", b"\xfd7zXZ"), "decompress it first: xz -d a.laz.xz", "", 2),
    "UTF-16": Row(file("a.xyz", TEXT.encode("utf-16")), "it is text in UTF-16; save it as UTF-8", "", 2),
    "degrees": Row(file("a.csv", b"lat lon h\n1 2 3\n"), "in degrees; project them to metres", "", 2),
    "E57, half of it in the scanner": Row(write_e57, "left out: 12,000 points (no return)", ""),
    "LAZ, points withheld, noise": Row(write_laz, "2,400 points (withheld), 2 points (noise)", "", facts={"crs": WKT}),
    "PTX": Row(file("a.ptx", ptx(POINTS - 50.0, (50.0, 50.0, 50.0)).encode()), "format PTX", "--reverse"),
    "PTS": Row(file("a.pts", f"{len(POINTS)}\n{TEXT}".encode()), "registered cloud", ""),
    "two LiDARs": Row(small(("/front/points", "/rear/points", "/map")),
                      "holds 2 LiDARs, /front/points, /rear/points; --topic says which", "", 2),
    "times of two readings": Row(small(("/points",), time=2.5), "fit two readings: s, sweeps of 0.245 s, or ms", "", 2),
}  # fmt: skip


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> Drive:
    one = drive_through(RecordingsConfig(), tmp_path_factory.mktemp("drive"), "vlp16")
    (other := one.prism.with_name("other")).mkdir()
    drive_through(RecordingsConfig(seed=1), other, "vlp16")
    np.savetxt(one.prism.with_name("late.tum"), np.loadtxt(one.prism) + 2e8 * np.eye(1, 8), fmt="%.9f")
    return one


SLOW = [pytest.param(name, marks=pytest.mark.slow) if "{0}" in row.words else name for name, row in ROWS.items()]


@pytest.mark.parametrize("name", SLOW)
def test_a_row_of_the_table_ends_as_it_should(name, request, tmp_path, monkeypatch, capsys):
    row, out = ROWS[name], tmp_path / "scene"
    one = request.getfixturevalue("known") if "{0}" in row.words else None
    words = row.words.format(one and one.mounts.parent).split()
    monkeypatch.setattr(sys, "argv", ["scene.build", str(row.write(tmp_path, one)), *words, "--out", str(out)])
    assert main() == row.status
    said = capsys.readouterr()
    assert row.said in said.out + said.err
    assert out.exists() == (row.status == 0)
    if row.status == 2:
        (line,) = (line for line in said.err.splitlines() if not line.endswith(" left"))  # progress of a slow machine
        assert line.startswith("error: ")
    else:
        manifest = json.loads((out / "manifest.json").read_text())
        keep({part: manifest[part] for part in ("detected", "judgement")})
        assert row.facts.items() <= manifest["detected"].items()
