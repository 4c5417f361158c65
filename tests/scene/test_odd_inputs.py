"""Well-formed and unusual files: what is no return is left out and counted, splits are read, packed ones named."""

import subprocess
import sys
import xml.etree.ElementTree as ET

import laspy
import numpy as np
import pytest
import trimesh
from laspy.vlrs.known import WktCoordinateSystemVlr
from mujoco import MjModel

from scene.build import blame_poses
from scene.errors import Code, RecordingError
from scene.judging.judge import Warned
from scene.limits import list_limits
from scene.reading.cloudfile import read_cloud
from scene.reading.formats import ReadingConfig
from scene.reading.recording import Recording
from scene.writing.folder import SCENES, state_crs
from tests.scene.bags import write_bag
from tests.scene.conventions import sweeps, write_convention

XYZ = np.random.default_rng(0).uniform(1, 9, (500, 3))
WKT = 'PROJCS["ETRS89 / UTM zone 33N",GEOGCS["ETRS89",UNIT["degree",0.0174]],UNIT["metre",1],AUTHORITY["EPSG","25833"]]'


def write_las(path, points, withheld=(), noise=(), crs=""):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [1e-4] * 3
    if crs:
        header.vlrs.append(WktCoordinateSystemVlr(crs))
        header.global_encoding.wkt = True
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    flags, kinds = np.zeros(len(points), np.uint8), np.ones(len(points), np.uint8)
    flags[list(withheld)] = 1
    kinds[list(noise)] = [7, 18][: len(noise)]
    data.withheld, data.classification = flags, kinds
    data.write(str(path))
    return path


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_withheld_points_and_noise_are_left_out_and_counted_unless_kept(tmp_path, suffix):
    path = write_las(tmp_path / f"a.{suffix}", XYZ, withheld=range(30), noise=(40, 41))
    cloud, facts = read_cloud(path, 0.001)
    assert facts["points_left_out"] == {"withheld": 30, "noise": 2}
    assert cloud.returns == len(XYZ) - 32
    cloud, facts = read_cloud(path, 0.001, ReadingConfig(keep_noise=True))
    assert "points_left_out" not in facts
    assert cloud.returns == len(XYZ)


def ptx(points, place, rows=50, matrix=None) -> str:
    matrix = np.eye(4) if matrix is None else matrix
    matrix = matrix.copy()
    matrix[3, :3] = place
    head = [str(len(points) // rows), str(rows), "{} {} {}".format(*place), "1 0 0", "0 1 0", "0 0 1"]
    head += [" ".join(f"{value:.6f}" for value in row) for row in matrix]
    return "\n".join([*head, *(f"{x:.4f} {y:.4f} {z:.4f} 0.5" for x, y, z in points)]) + "\n"


def test_a_ptx_of_two_scans_is_read_in_one_frame_without_its_empty_directions(tmp_path, small_blocks):
    turned = np.eye(4)
    turned[:2, :2] = [[0.0, 1.0], [-1.0, 0.0]]  # a row of coordinates times this: by 90° to the left
    first, second = XYZ.copy(), XYZ.copy()
    first[:20] = 0.0
    path = tmp_path / "a.ptx"
    path.write_text(ptx(first, (10.0, 20.0, 5.0)) + ptx(second, (40.0, 20.0, 5.0), matrix=turned))
    cloud, facts = read_cloud(path, 0.0005)
    assert facts["format"] == "PTX"
    assert facts["points_left_out"] == {"no_return": 20}
    found = np.sort((cloud.points + cloud.origin)[:, 0])
    expected = np.sort(np.concatenate([first[20:, 0] + 10.0, 40.0 - second[:, 1]]))
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text[:4000], r"line \d+ has no numbers|it ends \d+ of \d+ points before a scan's header says"),
        (lambda text: text.replace("1 0 0", "one 0 0", 1), "lines 1 to 10 are no header of a PTX scan"),
        (lambda text: text.replace(" 0.5", "x", 1).replace(".", "?", 40), "lines 1 to 10|line 11 has no numbers"),
    ],
)
def test_a_damaged_ptx_is_named_with_its_line(tmp_path, change, said):
    path = tmp_path / "a.ptx"
    path.write_text(change(ptx(XYZ, (10.0, 20.0, 5.0))))
    with pytest.raises(RecordingError, match=rf"a\.ptx: not a readable PTX cloud \(.*({said})"):
        read_cloud(path, 0.01)


def split(tmp_path):
    """The bags of one drive, whose names do not tell their order."""
    whole = [(start, points) for start, points, _ in sweeps(9)]
    folder = tmp_path / "split"
    folder.mkdir()
    return folder, [
        write_bag(folder / f"run_{name}.bag", whole[k : k + 3]) for name, k in (("c", 0), ("a", 3), ("b", 6))
    ]


def test_a_folder_of_split_bags_is_read_in_the_order_of_time(tmp_path):
    folder, _ = split(tmp_path)
    with Recording(folder) as recording:
        scans = list(recording.scans())
        picked = [number for number, _ in recording.pick([7, 2])]
    assert recording.facts["bags"] == 3
    assert recording.scan_count == 9
    assert [scan.stamp for scan in scans] == pytest.approx([start for start, _, _ in sweeps(9)], abs=1e-6)
    assert picked == [2, 7]


def test_several_bags_on_the_command_line_are_one_recording(tmp_path):
    _, bags = split(tmp_path)
    with Recording(bags[1], more=(bags[0], bags[2])) as recording:
        assert [scan.stamp for scan in recording.scans()] == pytest.approx(
            [start for start, _, _ in sweeps(9)], abs=1e-6
        )
    cloud = write_las(tmp_path / "a.las", XYZ)
    with pytest.raises(RecordingError, match=r"a\.las: is no ROS1 bag as .*run_c\.bag is, so no part of one recording"):
        Recording(bags[0], more=(cloud,))


def test_a_bag_whose_index_was_never_written_says_so(tmp_path):
    raw = bytearray(write_convention(tmp_path / "a.bag").read_bytes())
    place = raw.index(b"index_pos=") + len(b"index_pos=")
    raw[place : place + 8] = bytes(8)
    (tmp_path / "b.bag").write_bytes(raw)
    with pytest.raises(RecordingError, match=r"b\.bag: not a whole ROS1 bag.*reindex before reading"):
        Recording(tmp_path / "b.bag")


def test_every_file_that_can_hold_one_has_the_crs_of_the_input(tmp_path):
    for scene in SCENES:
        (tmp_path / scene).write_text("<mujoco>\n  <worldbody />\n</mujoco>\n")
    np.savez(tmp_path / "tunnel.npz", station=XYZ)
    trimesh.PointCloud(XYZ).export(tmp_path / "lining.ply")
    state_crs(tmp_path, WKT)
    for scene in SCENES:
        MjModel.from_xml_path(str(tmp_path / scene))
        assert ET.parse(tmp_path / scene).find("custom/text[@name='crs']").get("data") == WKT
    with np.load(tmp_path / "tunnel.npz") as data:
        assert str(data["crs"]) == WKT
        np.testing.assert_array_equal(data["station"], XYZ)
    assert f"comment crs {WKT}".encode() in (tmp_path / "lining.ply").read_bytes()
    np.testing.assert_allclose(trimesh.load(tmp_path / "lining.ply").vertices, XYZ)


def test_nothing_in_the_bore_is_named_where_the_poses_scatter_the_returns():
    said = [
        Warned(Code.UNEXPLAINED, "7% lie further than 10 cm, most from 0 to 2 m, where it looks like a train"),
        Warned(Code.PLACE, "at 3 m: a train"),
        Warned(Code.UNSEEN, "a guess"),
    ]
    texts = [one.text for one in blame_poses(said)]
    assert texts == ["7% lie further than 10 cm; the poses, or their clock, scatter them", "a guess"]


def test_every_threshold_has_words():
    found = list(list_limits())
    assert len(found) > 300
    assert [(limit.part, limit.name) for limit in found if not limit.words] == []
    assert len({one.part.split(".")[0] for one in found}) == 6  # packages


def test_the_command_prints_those_that_are_asked_for():
    command = [sys.executable, "-m", "scene.limits", "fitting.floor"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert all(line.startswith("fitting.floor ") for line in shown)
    assert any("_LOWER = 0.05  # m" in line for line in shown)
