"""A user's settings for an input: extent, direction, unit and columns; and units found without them."""

import numpy as np
import pytest

from scene.build import reconstruct
from scene.cleaning.clean import crop_cloud, parse_box
from scene.cloud import Cloud
from scene.config import ReconstructConfig
from scene.errors import FitError, RecordingError, Refusal
from scene.progress import Stages
from scene.reading.cloudfile import read_cloud
from scene.reading.formats import ReadingConfig, detect
from scene.reading.ringsurvey import read_ring_survey
from tests.scene.clouds import curved_d_bore
from tests.scene.files import write_e57, write_las, write_ply, write_text

KNOWN = curved_d_bore(length=24, per_metre=4000, offset=(12.0, -3.0, 2.0))


def test_a_box_keeps_what_is_inside_it_in_the_frame_of_the_input():
    points = np.array([[0, 0, 0], [5, 0, 0], [5, 5, 9]], np.float32)
    cloud = Cloud(points, np.ones(3, np.float32), np.array([100.0, 200.0, 0.0]), 3, 0.04)
    assert len(crop_cloud(cloud, None).points) == 3
    np.testing.assert_array_equal(crop_cloud(cloud, "106,198,104,206").points, points[1:])  # in plan, corners any way
    np.testing.assert_array_equal(crop_cloud(cloud, "104,198,-1,106,206,5").points, points[1:2])
    with pytest.raises(FitError, match=r"x 100\.0 to 105\.0") as raised:
        crop_cloud(cloud, "0,0,9,9")
    assert raised.value.code is Refusal.CROP


@pytest.mark.parametrize("text", ["1,2,3", "a,b,c,d", "1,2,1,5", "nan,0,1,1"])
def test_a_box_that_is_none_is_refused(text):
    with pytest.raises(FitError, match="--crop"):
        parse_box(text)


@pytest.mark.parametrize(("unit", "scale"), [("cm", 100), ("mm", 1000), ("m", 1)])
@pytest.mark.parametrize("write", [write_ply, write_las, write_text, write_e57])
def test_cm_and_mm_are_told_by_the_height_of_the_bore_even_where_a_file_says_metres(tmp_path, write, unit, scale):
    name = {write_ply: "a.ply", write_las: "a.las", write_text: "a.xyz", write_e57: "a.e57"}[write]
    path = write(tmp_path / name, (KNOWN.points[::4] - [12, -3, 2]) * scale)
    cloud, facts = read_cloud(path, 0.04)
    assert facts["unit"].split(" ")[0] == unit
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), np.ptp(KNOWN.points, axis=0), atol=0.15)


@pytest.mark.parametrize(
    ("unit", "scale", "doubted"), [("mm", 1, "m"), ("m", 1000, "mm"), ("cm", 100, ""), ("ft", 1, "")]
)
def test_a_unit_by_flag_that_the_cloud_contradicts_is_named_where_no_bore_can_be_fitted(tmp_path, unit, scale, doubted):
    path = write_ply(tmp_path / "a.ply", KNOWN.points[::4] * scale)
    assert ("unit_doubt" in read_cloud(path, 0.04, ReadingConfig(unit=unit))[1]) == bool(doubted)
    if doubted:
        reading = ReconstructConfig(reading=ReadingConfig(unit=unit))
        with pytest.raises(FitError, match=rf"a\.ply: --unit {unit}, but .* its points look like {doubted}; no bore"):
            reconstruct(path, None, reading, Stages())


def test_a_long_climbing_tunnel_in_metres_is_no_tunnel_in_cm(tmp_path):
    """700 m by 700 m in plan, 600 m in height: no extent tells the unit, the height of its columns does."""
    rng = np.random.default_rng(0)
    along, turn = rng.random(40_000) * 990, rng.uniform(-np.pi, np.pi, 40_000)
    points = np.column_stack([0.7 * along, 0.7 * along + 2.7 * np.cos(turn), 0.6 * along + 2.7 * np.sin(turn)])
    assert read_cloud(write_ply(tmp_path / "a.ply", points), 0.04)[1]["unit"].startswith("m ")


HEADERS = {
    "Rechtswert;Hochwert;Hoehe": (0, 1, 2),
    "Hochwert;Rechtswert;Höhe": (1, 0, 2),
    "Hoehe [m];Rechtswert [m];Hochwert [m]": (1, 2, 0),
    "Ost;Nord;Kote": (0, 1, 2),
    "Este;Norte;Cota": (0, 1, 2),
    "Est;Nord;Altitude": (0, 1, 2),
    "Northing;Easting;RL": (1, 0, 2),
    "z;x;y": (1, 2, 0),
}


@pytest.mark.parametrize("header", HEADERS)
def test_headers_that_surveyors_use_are_read_in_any_order(tmp_path, header):
    points = np.random.default_rng(1).uniform(0, 1, (50, 3)) * [90.0, 20.0, 15.0]
    columns = np.empty_like(points)
    for axis, column in enumerate(HEADERS[header]):
        columns[:, column] = points[:, axis]
    cloud, _ = read_cloud(write_text(tmp_path / "a.csv", columns, ";", header), 1e-4)
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), np.ptp(points, axis=0), atol=1e-3)


@pytest.mark.parametrize("columns", ["x=A,y=B,z=C", "x=2,y=3,z=4"])
def test_columns_that_the_user_names_are_read(tmp_path, columns):
    rows = np.random.default_rng(2).uniform(0, 1, (60, 4)) * [1, 90, 20, 15]
    path = tmp_path / "a.csv"
    path.write_text("Id,A,B,C\n" + "\n".join(",".join(f"{v:.5f}" for v in row) for row in rows))
    cloud, _ = read_cloud(path, 1e-3, ReadingConfig(columns=columns))
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), np.ptp(rows[:, 1:], axis=0), atol=1e-3)


@pytest.mark.parametrize(
    ("columns", "said"),
    [("x=A,y=B", r"a\.csv: .*no .*columns"), ("x=Q,y=B,z=C", r"a\.csv: .*"), ("q=A", r"columns 'q=A' are not pairs")],
)
def test_columns_that_are_not_there_are_refused(tmp_path, columns, said):
    path = tmp_path / "a.csv"
    path.write_text("Id,A,B,C\n" + "\n".join("1,2,3,4" for _ in range(9)))
    with pytest.raises(RecordingError, match=said):
        read_cloud(path, 0.04, ReadingConfig(columns=columns))
    with pytest.raises(RecordingError, match="--columns goes with a table"):
        read_cloud(write_ply(tmp_path / "a.ply", KNOWN.points[:50]), 0.04, ReadingConfig(columns="x=A,y=B,z=C"))


def ring_rows() -> list[str]:
    return [
        f"{ring};{k};{10 * ring + 2.7 * 0:.3f};{2.7 * np.cos(k):.3f};{2.7 * np.sin(k):.3f}"
        for ring in range(6) for k in range(7)
    ]  # fmt: skip


def test_a_ring_survey_in_german_and_one_whose_columns_are_named(tmp_path):
    path = tmp_path / "rings.csv"
    path.write_text("\n".join(["Ring;Punkt;Rechtswert;Hochwert;Hoehe", *ring_rows()]))
    assert detect(path).format.kind == "rings"
    assert len(read_ring_survey(path).names) == 6
    assert read_ring_survey(path).reversed().names == ["5", "4", "3", "2", "1", "0"]
    odd = tmp_path / "odd.csv"
    odd.write_text("\n".join(["R;P;U;V;W", *ring_rows()]))
    columns = {"x": "U", "y": "V", "z": "W", "ring": "R", "point": "P"}
    np.testing.assert_array_equal(read_ring_survey(odd, given=columns).points, read_ring_survey(path).points)


def test_a_cloud_with_numbers_of_points_is_no_ring_survey(tmp_path):
    path = tmp_path / "cloud.csv"
    path.write_text("\n".join(["Punkt;Rechtswert;Hochwert;Hoehe", *(row.partition(";")[2] for row in ring_rows())]))
    assert detect(path).format.kind == "cloud"
