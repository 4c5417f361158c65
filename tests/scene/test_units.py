"""Units that a file declares: metres, millimetres and both kinds of foot; anything else is refused or overridden."""

import struct

import laspy
import numpy as np
import pytest

from scene.errors import RecordingError
from scene.reading.cloudfile import read_cloud
from scene.reading.formats import ReadingConfig
from scene.reading.tables import plain_name
from tests.scene.clouds import curved_d_bore
from tests.scene.files import write_las, write_text

POINTS = np.random.default_rng(0).uniform(0, 1, (500, 3)) * [90.0, 20.0, 15.0]
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
    cloud, facts = read_cloud(write_las(tmp_path / "a.las", POINTS, record), 1e-4)
    assert facts["unit"] == f"{unit} (declared)"
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), np.ptp(POINTS, axis=0) * metres, atol=1e-3)


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
    path = write_las(tmp_path / "a.las", POINTS, record)
    with pytest.raises(RecordingError, match=rf"a\.las: its coordinates are in {said}, not in m, cm, mm, ft or us-ft"):
        read_cloud(path, 0.1)
    assert read_cloud(path, 0.1, ReadingConfig(unit="m"))[1]["unit"] == "m (by flag)"


@pytest.mark.parametrize(
    ("text", "base", "unit"),
    [("EASTING (FT.)", "easting", "ft"), ("x [feet]", "x", "ft"), ("y_ft", "y", "ft"), ("Z (US FT)", "z", "us-ft"),
     ("Z (usft)", "z", "us-ft"), ("x_m", "x", "m"), ("foot", "foot", None)],
)  # fmt: skip
def test_headers_in_feet_are_understood(text, base, unit):
    assert plain_name(text) == (base, unit)


def test_a_table_whose_header_says_feet_is_read_in_feet(tmp_path):
    cloud, facts = read_cloud(write_text(tmp_path / "a.csv", POINTS, ",", "X (ft),Y (ft),Z (ft)"), 1e-4)
    assert facts["unit"] == "ft (declared)"
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), np.ptp(POINTS, axis=0) * 0.3048, atol=1e-3)


def test_coordinates_rounded_to_centimetres_are_told_and_those_rounded_to_half_a_metre_refused(tmp_path):
    bore = curved_d_bore(length=20.0, per_metre=1500, offset=(0.0, 0.0, 0.0)).points
    for step in (0.001, 0.05, 0.5):
        np.savetxt(tmp_path / f"{step}.xyz", np.round(bore / step) * step, fmt="%.3f")
    assert "rounded_to" not in read_cloud(tmp_path / "0.001.xyz", 0.04)[1]
    assert read_cloud(tmp_path / "0.05.xyz", 0.04)[1]["rounded_to"] == pytest.approx(0.05, abs=1e-6)
    with pytest.raises(RecordingError, match=r"rounded to 0\.5 m"):
        read_cloud(tmp_path / "0.5.xyz", 0.04)
