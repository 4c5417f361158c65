"""Clouds of every format come back in metres, z up, by flag, declaration or detection; anything else is refused."""

import struct
import sys

import laspy
import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scene.cleaning.sort import part_of_cloud
from scene.cloud import VoxelMean, thin_cloud
from scene.errors import RecordingError
from scene.poses.place import register_scans
from scene.poses.trajectory import Trajectory
from scene.progress import Stages
from scene.reading.cloudfile import measure_rounding, read_cloud
from scene.reading.formats import ReadingConfig
from scene.reading.recording import Recording
from scene.reading.source import choose_frame
from scene.reading.tables import find_xyz, plain_name
from tests.scene.clouds import curved_d_bore
from tests.scene.files import CLOUDS, write_e57, write_las, write_text, write_xlsx
from tests.scene.fits import keep
from tests.scene.messages import VELODYNE, pointcloud2, write_bag1


def test_a_voxel_keeps_the_mean_and_the_number_of_its_points():
    thinned = VoxelMean(1.0)
    thinned.add(np.array([[5.1, 0.1, 0.1], [5.3, 0.3, 0.3]]))
    thinned.add(np.array([[5.2, 0.2, 0.5], [7.5, 0.5, 0.5], [np.nan, 0, 0], [2e6, 0, 0]]))
    cloud = thinned.cloud()
    order = np.argsort(cloud.points[:, 0])
    np.testing.assert_allclose(cloud.points[order] + cloud.origin, [[5.2, 0.2, 0.3], [7.5, 0.5, 0.5]], atol=1e-6)
    np.testing.assert_array_equal(cloud.weights[order], [3, 1])
    assert cloud.returns == 4


def test_the_origin_is_whole_metres_so_that_nothing_is_lost_far_away():
    thinned = VoxelMean(0.01)
    thinned.add(np.array([[271540.0078, 2104023.106, -14.0345]]))
    cloud = thinned.cloud()
    assert (cloud.origin == np.round(cloud.origin)).all()
    np.testing.assert_allclose(cloud.points[0] + cloud.origin, [271540.0078, 2104023.106, -14.0345], atol=1e-6)


# No two coordinates nearer than the formats round, so that points can be put in order.
RNG = np.random.default_rng(0)
POINTS = np.column_stack([RNG.permutation(np.linspace(-a, a, 500, dtype=np.float32)) for a in (30, 3, 3)])
NONE = np.empty((0, 3))


def points_of(path, **config):
    cloud, facts = read_cloud(path, 1e-4, ReadingConfig(**config))
    back = cloud.points + cloud.origin
    return back[np.lexsort(back.T)], facts


def ordered(points):
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("name", CLOUDS)
def test_every_format_comes_back_as_it_was_written(tmp_path, name, small_blocks):
    back, facts = points_of(CLOUDS[name](tmp_path / name, POINTS))
    keep(facts)
    np.testing.assert_allclose(back, ordered(POINTS), atol=2e-5)
    assert facts["points_read"] == 500
    assert facts["points_dropped"] == 0


@pytest.mark.parametrize("name", [name for name in CLOUDS if "xyz" not in name and "csv" not in name])
def test_a_format_is_known_by_its_content_where_the_name_lies(tmp_path, name):
    path = CLOUDS[name](tmp_path / name, POINTS).rename(tmp_path / "cloud.dat")
    np.testing.assert_allclose(points_of(path)[0], ordered(POINTS), atol=2e-5)


def test_each_scan_of_an_e57_is_placed_by_its_own_pose(tmp_path):
    quarter = (np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]), np.array([100.0, 0, 5]))
    still = (np.array([1.0, 0, 0, 0]), np.array([0.0, 0, 0]))
    back, facts = points_of(write_e57(tmp_path / "a.e57", POINTS, still, quarter))
    turned = np.column_stack([100 - POINTS[:, 1], POINTS[:, 0], POINTS[:, 2] + 5])
    np.testing.assert_allclose(back, ordered(np.concatenate([POINTS, turned])), atol=2e-5)
    assert facts["format"] == "E57, 2 scans"


def test_only_an_e57_needs_the_library_that_reads_it(tmp_path, monkeypatch):
    path = write_e57(tmp_path / "a.e57", POINTS)
    monkeypatch.setitem(sys.modules, "pye57", None)  # as if it were not installed
    with pytest.raises(RecordingError, match=r"a\.e57: E57 is read by pye57, which is not installed"):
        points_of(path)


def test_a_flag_comes_before_a_declaration_and_a_declaration_before_detection(tmp_path):
    path = write_text(tmp_path / "a.csv", POINTS, ",", "x (mm),y (mm),z (mm)")
    assert points_of(path)[1]["unit"] == "mm (declared)"
    assert points_of(path, unit="m")[1]["unit"] == "m (by flag)"


def test_axes_are_taken_in_the_order_that_the_flag_gives():
    frame = choose_frame(NONE, None, "m", "-yxz")
    np.testing.assert_array_equal(frame.apply(np.array([[1.0, 2, 3]])), [[-2, 1, 3]])
    assert "mirrored" not in frame.facts["axes"]
    assert "mirrored" in choose_frame(NONE, None, "m", "xzy").facts["axes"]


def test_a_cloud_that_lies_along_z_is_turned_and_says_so():
    along_z = POINTS[:, [1, 2, 0]]
    frame = choose_frame(along_z, None, None, None)
    assert "y is taken as up" in frame.facts["axes"]
    np.testing.assert_allclose(frame.apply(along_z), np.column_stack([POINTS[:, 1], -POINTS[:, 0], POINTS[:, 2]]))
    assert choose_frame(along_z, None, None, "xyz").facts["axes"] == "xyz (by flag)"
    for high in ((25.0, 25.0, 40.0), (4.0, 4.0, 25.0)):  # a hall and a shaft, which no tunnel on its side is
        assert choose_frame(np.indices((2, 2, 2)).reshape(3, -1).T * high, None, None, None).axes == "xyz"


@pytest.mark.parametrize(
    ("config", "sentence"),
    [({"unit": "yd"}, "unit 'yd' is none of m, cm, mm, ft or us-ft"), ({"axes": "xxz"}, "axes 'xxz' are not"),
     ({"format": "docx"}, "format 'docx' is none of"), ({"format": "las"}, "not a readable LAS cloud")],
)  # fmt: skip
def test_a_wrong_flag_is_named(tmp_path, config, sentence):
    with pytest.raises(RecordingError, match=rf"a\.xyz: {sentence}"):
        points_of(write_text(tmp_path / "a.xyz", POINTS), **config)


def test_metres_taken_for_something_else_by_a_flag_end_in_a_sentence(tmp_path):
    far = POINTS * 1e6
    with pytest.raises(RecordingError, match=r"a\.xyz: most of its points lie further apart .* is the unit mm"):
        points_of(write_text(tmp_path / "a.xyz", far), unit="m")


def test_a_bad_line_is_named_by_its_number(tmp_path):
    path = write_text(tmp_path / "a.csv", POINTS, ",", "x,y,z")
    lines = path.read_text().splitlines()
    lines[300] = "1,two,3"
    path.write_text("\n".join(lines))
    with pytest.raises(RecordingError, match=r"a\.csv: not a readable table cloud \(line 301 has no numbers"):
        points_of(path)


HUGE = {
    "a.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n",
    "ascii.ply": b"ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n1 2 3\n",
    "a.pcd": b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 99999999999\nHEIGHT 1\n"
    b"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 99999999999\nDATA binary\n" + bytes(99),
}
HUGE["packed.pcd"] = HUGE["a.pcd"].replace(b"DATA binary", b"DATA binary_compressed")


@pytest.mark.parametrize("name", HUGE)
def test_a_header_that_claims_a_gigantic_count_is_refused_before_anything_is_allocated(tmp_path, name):
    (tmp_path / name).write_bytes(HUGE[name])
    with pytest.raises(RecordingError, match="its header promises"):
        points_of(tmp_path / name)


@pytest.mark.parametrize("name", [name for name in CLOUDS if "e57" not in name and "la" not in name])
def test_points_that_are_not_finite_are_dropped_and_counted_and_a_cloud_of_them_is_refused(tmp_path, name):
    some = POINTS.copy()
    some[::5] = np.nan
    back, facts = points_of(CLOUDS[name](tmp_path / name, some))
    np.testing.assert_allclose(back, ordered(some[np.isfinite(some).all(axis=1)]), atol=2e-5)
    assert (facts["points_read"], facts["points_dropped"]) == (500, 100)
    with pytest.raises(RecordingError, match="none of its 500 points is finite"):
        points_of(CLOUDS[name](tmp_path / name, np.full_like(POINTS, np.nan)))


@pytest.mark.parametrize("name", ["ascii.ply", "a.csv", "empty.pcd"])
def test_a_cloud_without_points_is_refused(tmp_path, name):
    path = tmp_path / name
    if name == "empty.pcd":
        whole = CLOUDS["a.pcd"](path, POINTS).read_bytes()
        path.write_bytes(whole.replace(b"WIDTH 500", b"WIDTH 0").replace(b"POINTS 500", b"POINTS 0"))
    else:
        CLOUDS[name](path, NONE)
    with pytest.raises(RecordingError, match=rf"{name}: (holds no points|not a readable table cloud)"):
        points_of(path)


def test_a_ring_survey_is_no_cloud(tmp_path):
    with pytest.raises(RecordingError, match=r"a\.xlsx: is no registered cloud"):
        points_of(write_xlsx(tmp_path / "a.xlsx", [(0, 1, 1.0, 2.0, 3.0, 0.0)]))


BOX = np.random.default_rng(0).uniform(0, 1, (500, 3)) * [90.0, 20.0, 15.0]
US_FOOT = 1200 / 3937
GEOGCS = (
    'GEOGCS["NAD83",DATUM["d",SPHEROID["GRS 1980",6378137,298.257222101]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]'
)
WKT1 = 'PROJCS["NAD83 / New York",{},PROJECTION["p"],PARAMETER["false_easting",984250],UNIT["{}",{}]]'
WKT2 = (
    'PROJCRS["a",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["GRS 1980",6378137,298.257,LENGTHUNIT["metre",1]]]],'
    'CONVERSION["c",PARAMETER["False easting",0,LENGTHUNIT["metre",1]]],CS[Cartesian,2],'
    'AXIS["x",east],AXIS["y",north],LENGTHUNIT["US survey foot",0.304800609601219]]'
)


def wkt(text: str) -> laspy.VLR:
    return laspy.VLR("LASF_Projection", 2112, "", text.encode() + b"\0")


def keys(**values: int) -> laspy.VLR:
    numbers = {"model": 1024, "linear": 3076, "vertical": 4099}
    body = struct.pack("<4H", 1, 1, 0, len(values))
    body += b"".join(struct.pack("<4H", numbers[name], 0, 1, value) for name, value in values.items())
    return laspy.VLR("LASF_Projection", 34735, "", body)


DECLARED = {
    "wkt, US foot": (wkt(WKT1.format(GEOGCS, "US survey foot", "0.304800609601219")), "us-ft", US_FOOT),
    "wkt, foot": (wkt(WKT1.format(GEOGCS, "foot", "0.3048")), "ft", 0.3048),
    "wkt, metre": (wkt(WKT1.format(GEOGCS, "metre", "1")), "m", 1.0),
    "wkt 2": (wkt(WKT2), "us-ft", US_FOOT),
    "compound": (
        wkt(
            f'COMPD_CS["c",{WKT1.format(GEOGCS, "foot", "0.3048")},VERT_CS["v",VERT_DATUM["d",2005],UNIT["ft",0.3048]]]'
        ),
        "ft",
        0.3048,
    ),
    "keys, US foot": (keys(model=1, linear=9003), "us-ft", US_FOOT),
    "keys, foot": (keys(model=1, linear=9002, vertical=9002), "ft", 0.3048),
    "keys, metre": (keys(model=1, linear=9001), "m", 1.0),
}


@pytest.mark.parametrize("name", DECLARED)
def test_a_las_file_is_taken_in_the_unit_of_its_coordinate_system(tmp_path, name):
    record, unit, metres = DECLARED[name]
    cloud, facts = read_cloud(write_las(tmp_path / "a.las", BOX, record), 1e-4)
    assert facts["unit"] == f"{unit} (declared)"
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), np.ptp(BOX, axis=0) * metres, atol=1e-3)


REFUSED = {
    "degrees by wkt": (wkt(GEOGCS), "degrees"),
    "degrees by keys": (keys(model=2), "degrees"),
    "chains": (wkt(WKT1.format(GEOGCS, "chain", "20.1168")), r"chain \(20\.1168 m\)"),
    "two units": (keys(model=1, linear=9003, vertical=9001), "us-ft in plan and m in height"),
    "unknown code": (keys(model=1, linear=9036), "EPSG unit 9036"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_units_are_refused_by_name_unless_a_flag_overrides(tmp_path, name):
    record, said = REFUSED[name]
    path = write_las(tmp_path / "a.las", BOX, record)
    with pytest.raises(RecordingError, match=rf"a\.las: its coordinates are in {said}, not in m, cm, mm, ft or us-ft"):
        read_cloud(path, 0.1)
    assert read_cloud(path, 0.1, ReadingConfig(unit="m"))[1]["unit"] == "m (by flag)"


@pytest.mark.parametrize(
    ("text", "base", "unit"),
    [("EASTING (FT.)", "easting", "ft"), ("x [feet]", "x", "ft"), ("y_ft", "y", "ft"), ("Z (US FT)", "z", "us-ft"),
     ("Z (usft)", "z", "us-ft"), ("x_m", "x", "m"), ("foot", "foot", None), ("EASTING (M.)", "easting", "m"),
     ("//X [mm]", "x", "mm"), ("m", "m", None)],
)  # fmt: skip
def test_names_of_columns_give_their_unit(text, base, unit):
    assert plain_name(text) == (base, unit)


def test_columns_that_differ_in_unit_are_refused():
    with pytest.raises(ValueError, match="differ in unit"):
        find_xyz(["x (mm)", "y (m)", "z (mm)"])


def test_coordinates_rounded_to_centimetres_are_told_and_those_rounded_to_half_a_metre_refused(tmp_path):
    bore = curved_d_bore(length=20.0, per_metre=1500, offset=(0.0, 0.0, 0.0)).points
    for step in (0.001, 0.05, 0.5):
        np.savetxt(tmp_path / f"{step}.xyz", np.round(bore / step) * step, fmt="%.3f")
    assert "rounded_to" not in read_cloud(tmp_path / "0.001.xyz", 0.04)[1]
    assert read_cloud(tmp_path / "0.05.xyz", 0.04)[1]["rounded_to"] == pytest.approx(0.05, abs=1e-6)
    rng = np.random.default_rng(3)
    seven = [rng.permutation(np.repeat(0.05 * np.arange(200), 7)) for _ in range(3)]  # too few of each to be a grid
    np.savetxt(tmp_path / "seven.xyz", np.column_stack(seven), fmt="%.3f")
    assert "rounded_to" not in read_cloud(tmp_path / "seven.xyz", 0.04, ReadingConfig(unit="m"))[1]
    with pytest.raises(RecordingError, match=r"rounded to 0\.5 m"):
        read_cloud(tmp_path / "0.5.xyz", 0.04)


BRIGHT = {"intensity": np.linspace(10, 200, 300).astype(np.float32)}
XYZ = np.random.default_rng(8).uniform(-9, 9, (300, 3)).astype(np.float32)


def bright_ply(path):
    cloud = trimesh.PointCloud(XYZ)
    cloud.vertex_attributes = BRIGHT
    cloud.export(path)


def bright_pcd(path):
    fields = ("x", "y", "z", "intensity")
    PointCloud.from_points(np.column_stack([XYZ, BRIGHT["intensity"]]), fields, (np.float32,) * 4).save(path)


def bright_las(path):
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z, las.intensity = *XYZ.T, BRIGHT["intensity"].astype(np.uint16)
    las.write(str(path))


def bright_bag(path):
    columns = dict(zip("xyz", XYZ.T, strict=True)) | BRIGHT | {"ring": 0, "time": np.linspace(0, 0.1, 300)[::-1]}
    write_bag1(path, {"/points": [(1.0 + k, pointcloud2(1.0 + k, VELODYNE, 22, columns)) for k in (0.0, 0.1)]})


@pytest.mark.parametrize(("name", "write"), [("a.ply", bright_ply), ("a.pcd", bright_pcd), ("a.las", bright_las)])
def test_the_intensity_of_a_point_stays_with_it(tmp_path, name, write):
    write(tmp_path / name)
    assert_bright(read_cloud(tmp_path / name, 0.001)[0], 1.0)


def test_the_intensity_of_a_return_stays_with_it(tmp_path):
    bright_bag(tmp_path / "a.bag")
    still = Trajectory(np.array([0.0, 9.0]), np.zeros((2, 3)), Rotation.identity(2), "still")
    with Stages() as stages, Recording(tmp_path / "a.bag") as recording:
        stage = stages.start("registering", 2)
        assert_bright(register_scans(recording, still, 0.001, stage).cloud, 1e-3)


def assert_bright(cloud, off: float) -> None:
    """The cleaned and thinned cloud has the intensity of the point that lies there."""
    picked = part_of_cloud(cloud, np.arange(0, len(cloud.points), 2))
    thinned = thin_cloud(picked, 0.002)
    near = cKDTree(XYZ).query(thinned.points + thinned.origin)[1]
    np.testing.assert_allclose(thinned.intensity, BRIGHT["intensity"][near], atol=off)


def test_a_mean_of_nothing_is_an_empty_cloud():
    empty = VoxelMean(0.05).cloud()
    assert (empty.points.shape, empty.weights.shape, empty.origin.tolist()) == ((0, 3), (0,), [0.0, 0.0, 0.0])
    assert (empty.returns, empty.voxel, empty.intensity) == (0, 0.05, None)


def test_each_axis_of_a_cloud_has_its_own_rounding():
    rng = np.random.default_rng(0)
    points = np.column_stack([0.5 * rng.integers(0, 20, 4000), 0.25 * rng.integers(0, 40, 4000), rng.normal(size=4000)])
    assert measure_rounding(points) == (0.5, 0.25, 0.0)
