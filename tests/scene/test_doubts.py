"""Bores that no tunnel is like are named with the likely cause; the report of a build says so and stands alone."""

import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from scene.bore import STATION_STEP, Bore
from scene.build import build
from scene.config import BuildConfig
from scene.errors import Code, FitError
from scene.geometry import axis_through
from scene.judging.judge import JudgingConfig, judge_bore
from scene.judging.page import render_page
from scene.judging.sanity import doubt_bore, doubt_layers
from tests.scene.clouds import curved_d_bore
from tests.scene.conftest import arc_bore
from tests.scene.fits import keep
from tests.scene.test_judging import about, block, cloud_of, on_wall

METRES = {"unit": "m (detected: least extent 6)", "axes": "xyz (by default, z up)"}


def codes(bore: Bore, facts: dict | None = None, provenance: dict | None = None) -> dict[str, str]:
    found = doubt_bore(bore, facts or METRES, provenance or {}, surveyed=True)
    return {warning.code: warning.text + (" REFUSES" if warning.refuses else "") for warning in found}


def scaled(bore: Bore, by: float) -> Bore:
    return replace(
        bore, width=bore.width * by, height=bore.height * by, radius=bore.radius * by, position=bore.position * by,
        station=bore.station * by,
    )  # fmt: skip


def climbing(grade: float) -> Bore:
    flat = arc_bore(grade=0.0, radius=1e5)
    points = np.outer(np.linspace(0, 24, 30), [0.6, 0.8, grade])
    axis = axis_through(points, STATION_STEP)
    rows = np.zeros(len(axis.station), int)
    sizes = {name: getattr(flat, name)[rows] for name in ("width", "height", "radius", "filled", "coverage")}
    return replace(
        flat, station=axis.station, position=axis.position, tangent=axis.tangent, lateral=axis.lateral, up=axis.up,
        **sizes,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("by", "said"),
    [(1 / 0.3048, r"--unit ft makes it 5\.6 m by 6 m"), (100, r"--unit cm makes .* REFUSES"),
     (1000, r"--unit mm makes .* REFUSES"), (0.01, "REFUSES")],
)  # fmt: skip
def test_sizes_of_no_tunnel_name_the_unit_that_would_make_one(bore, by, said):
    assert re.search(said, codes(scaled(bore, by))["size"])


def test_a_cm_cloud_taken_as_mm_is_told_by_its_size_and_a_size_that_the_user_told_is_not_doubted(bore):
    outcome = codes(scaled(bore, 0.1), {"unit": "mm (detected: least extent 550)"})["size"]
    assert "--unit cm makes it 5.6 m by 6 m" in outcome
    assert codes(scaled(bore, 2.2), {"unit": "m (by flag)"}) == {}


def test_grades_over_a_fifth_are_named_and_a_tunnel_on_end_is_refused():
    assert codes(climbing(0.15)) == {}
    steep = codes(climbing(0.27))["grade"]
    assert "27%" in steep
    assert "levelled" in steep
    assert "REFUSES" not in steep
    lying = codes(climbing(3.1))["grade"]
    assert "z is not up" in lying
    assert lying.endswith("REFUSES")


def test_a_section_on_its_side_is_noticed(bore):
    turned = replace(bore, radius=np.roll(bore.radius, 90, axis=1))  # its floor is now to the left
    assert "flat on the left" in codes(turned)["lying"]


def test_a_round_bore_along_z_is_a_shaft_and_one_with_a_floor_a_guess(bore):
    guessed = {**METRES, "axes": "x-zy (detected: longest along z, so y is taken as up)"}
    assert "taken as up" in codes(bore, guessed)["axes"]
    tube = replace(bore, radius=np.full_like(bore.radius, 3.0))
    outcome = codes(tube, guessed)["shaft"]
    assert re.search(r"a vertical shaft, \d+ m along z .*--axes x-zy.*REFUSES", outcome)
    assert "shaft" not in codes(tube, {**METRES, "axes": "x-zy (by flag)"})


def test_a_duct_that_was_taken_for_the_crown_dents_the_section(bore):
    dented = bore.radius.copy()
    near = np.abs(bore.angle - np.pi / 2) < 0.2
    dented[20:60, near] -= 0.9
    outcome = codes(replace(bore, radius=dented))["dent"]
    assert re.search(r"from 5 to 15 m the section is dented inwards by up to 0\.[89] m at the crown", outcome)
    shallow = bore.radius.copy()
    shallow[20:60, near] -= 0.1
    assert codes(replace(bore, radius=shallow)) == {}
    corridor = np.minimum(2.5 / np.abs(np.cos(bore.angle)), 3.0 / np.abs(np.sin(bore.angle)))
    void = np.sin(bore.angle) > 0.3  # an open ceiling, wider than the corridor under it
    corridor[void] = np.minimum(3.2 / np.abs(np.cos(bore.angle)), 4.0 / np.sin(bore.angle))[void]
    assert "dent" not in codes(replace(bore, radius=np.repeat(corridor[None], len(bore.station), axis=0)))
    short = bore.radius.copy()
    short[20:28, near] -= 0.9
    assert codes(replace(bore, radius=short)) == {}


def test_what_nobody_measured_is_said(bore):
    facts = {**METRES, "calibration": "none: the control is taken for the LiDAR's own origin"}
    assert "--calibration" in codes(bore, facts)["calibration"]
    assert "nothing measured the length" in codes(bore, {"length_fixed_by": "odometry; nothing measured it"})["length"]
    outcome = codes(bore, METRES, {"pockets": "by standard", "rings": "by standard"})["by_standard"]
    assert f"{len(bore.ring_station)} rings and {len(bore.pocket)} pockets" in outcome
    assert not doubt_bore(bore, METRES, {"pockets": "by standard"}, surveyed=False)


def test_the_page_shows_warnings_and_worst_stations_and_needs_nothing_else(bore):
    cloud = cloud_of(about(bore, *on_wall(bore)), block(bore, (9, 15), (-1, 1), (-3.1, -1.0)))
    judgement = judge_bore(bore, cloud, JudgingConfig())
    pages = [render_page("<bore> & co", bore, judgement, {"provenance": {"bore": "measured"}}) for _ in range(2)]
    assert pages[0] == pages[1]
    page = pages[0]
    keep([np.array(re.findall(r"-?\d+\.?\d*", part), float) for part in page.split("<svg")])
    assert "&lt;bore&gt; &amp; co" in page
    assert not re.search(r"https?:|<script|\bsrc=|\bhref=|url\(", page)
    assert len(page) < 600_000
    assert page.count("<figure>") == len([window for window in judgement.worst if window[2] > 0.002])
    assert 'class="warn' in page
    assert "m above the floor" in page


@pytest.fixture(scope="module")
def with_vehicle(tmp_path_factory):
    known = curved_d_bore(length=24, radius=1e6, grade=0.0, yaw=0.0, per_metre=3000, offset=(0.0, 0.0, 0.0))
    rng = np.random.default_rng(4)
    hanging = np.column_stack([rng.uniform(8, 14, 9000), rng.uniform(-0.5, 0.5, 9000), rng.uniform(0.2, 1.2, 9000)])
    path = tmp_path_factory.mktemp("cloud") / "vehicle.ply"
    trimesh.PointCloud(np.concatenate([known.points, hanging])).export(path)
    return path


def test_a_build_prints_and_writes_its_judgement(with_vehicle, tmp_path, capsys):
    out = tmp_path / "bore"
    build(with_vehicle, out)
    shown = capsys.readouterr()
    assert re.search(r"judged: \d+\.\d% of .* returns within 10 cm", shown.out)
    assert re.search(r"stations: 0 m at \(\d.*\); they grow arbitrarily: a registered cloud", shown.out)
    assert "track: none: the survey shows no rails; --track standard lays one" in shown.out
    manifest = json.loads((out / "manifest.json").read_text())
    judgement = manifest["judgement"]
    keep({part: manifest[part] for part in ("detected", "judgement")})
    assert 0.0 < judgement["share"]["explained"] < 1.0
    for warning in judgement["warnings"]:
        assert f"warning: {warning['text']} [{warning['code']}]" in shown.err
    assert judgement["warnings"]
    assert manifest["files"]["build.html"] == hashlib.sha256((out / "build.html").read_bytes()).hexdigest()


def test_a_build_that_explains_too_little_leaves_its_report_alone_and_force_builds_it(with_vehicle, tmp_path):
    config = BuildConfig(judging=JudgingConfig(refuse_above=0.01))
    with pytest.raises(FitError, match=r"vehicle\.ply: ") as raised:
        build(with_vehicle, tmp_path / "bore", config=config)
    assert raised.value.code is Code.UNEXPLAINED
    (report,) = tmp_path.iterdir()
    assert report.name == "bore-refused.html"
    page = report.read_text()
    assert 'class="warn grave"' in page
    assert "% of the returns lie further than 10 cm" in page
    assert "<figure>" in page
    forced = replace(config, judging=replace(config.judging, force=True))
    build(with_vehicle, tmp_path / "bore", config=forced)
    assert (tmp_path / "bore" / "build.html").exists()
    assert not report.exists()


@pytest.mark.parametrize(
    ("apart", "said"), [(0.0, None), (0.01, None), (0.05, " 5 cm apart"), (0.15, "1[45] cm apart")]
)
def test_a_wall_that_two_passes_show_twice_is_told(bore, apart, said):
    rng = np.random.default_rng(2)
    first, second = (np.array(on_wall(bore, 60_000, seed=seed)) for seed in (1, 2))
    second[1:] += np.array([[0.8 * apart], [0.6 * apart]])
    points = [about(bore, *part) + 0.004 * rng.standard_normal((60_000, 3)) for part in (first, second)]
    outcome = doubt_layers(bore, cloud_of(*points))
    assert [warning.code for warning in outcome] == ([] if said is None else ["doubled"])
    assert said is None or re.search(said, outcome[0].text)


def test_panels_side_by_side_are_no_second_wall(bore):
    rng = np.random.default_rng(3)
    station, lateral, upward = on_wall(bore, 120_000)
    raised = ((station / 0.3).astype(int) + (np.arctan2(upward, lateral) / 0.15).astype(int)) % 2 == 0
    out = 1.0 + np.where(raised, 0.08, 0.0) / np.hypot(lateral, upward)
    points = about(bore, station, lateral * out, upward * out) + 0.004 * rng.standard_normal((120_000, 3))
    assert doubt_layers(bore, cloud_of(points)) == []
