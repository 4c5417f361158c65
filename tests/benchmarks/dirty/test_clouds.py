import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.dirty import make
from benchmarks.dirty.__main__ import main as judge
from benchmarks.dirty.clouds.air import Alignment, Arch, prism, surface_of
from benchmarks.dirty.clouds.files import write_laz, write_truth
from benchmarks.dirty.clouds.mutations import MUTATIONS, Mutant
from benchmarks.dirty.clouds.recordings import _in_field, _in_niche, late, pitched, rolled, scalar_first, spoil_poses
from benchmarks.dirty.clouds.scanner import choose
from benchmarks.dirty.clouds.site import bore
from benchmarks.dirty.truth import Truth, find_cases, load_truth
from tests.scene.surveyed import load_trajectory


def test_a_bent_solid_keeps_its_section_and_runs_along_its_arc() -> None:
    alignment = Alignment(0.4, 80.0, 0.01, (100.0, 50.0, 7.0))
    surface = surface_of(prism(Arch().outline(), 0.0, 30.0), alignment)
    centre = alignment.place(np.array([[0.0, 80.0, 0.0]]))[0]  # of the arc: 80 m to the left
    radius = np.linalg.norm(surface.placed[:, :2] - centre[:2], axis=1)
    np.testing.assert_allclose(radius, 80.0 - surface.local[:, 1], atol=1e-9)
    end = alignment.place(np.array([[30.0, 0.0, 0.0]]))[0]
    turn = 0.4 + 30.0 / 80.0
    expected = centre[:2] + 80.0 * np.array([np.sin(turn), -np.cos(turn)])
    np.testing.assert_allclose(end, [*expected, 7.3], atol=1e-9)


def test_a_scan_meets_the_arch_with_the_scanners_noise_and_its_truth_is_on_it() -> None:
    rng = np.random.default_rng(3)
    site = bore(Alignment(1.0, -400.0, 0.005, (3000.0, 10.0, 2.0)), length=18.0)
    site = replace(site, tripods=site.tripods[:2])
    seen = site.scanned(rng)
    truth = site.truth(rng, seen)
    off = np.linalg.norm(seen.point - seen.exact, axis=1)
    assert 0.004 < np.sqrt(np.mean(off**2)) < 0.006
    assert not site.sky(seen.local).any()
    low = seen.local[:, 2] < 1e-6
    depth = site.arch.depth(seen.local[~low, 1], seen.local[~low, 2])
    assert np.abs(depth).max() < 0.005  # facets of the bent surface
    assert cKDTree(seen.exact).query(truth["wall"])[0].max() == 0.0
    assert len(choose(seen, low).point) > 1000  # floor, too


def small() -> Mutant:
    rng = np.random.default_rng(0)
    station = np.arange(0.0, 80.1, 0.25)
    axis = np.stack([10 + station, 0 * station, 3 + 0 * station], axis=1)
    wall = np.stack([10 + rng.uniform(2, 78, 4000), np.repeat([-2.5, 2.5], 2000), rng.uniform(1, 4, 4000)], axis=1)
    full = np.full(len(axis), 5.0)
    return Mutant(wall.copy(), Truth(axis, wall, (2.0, 78.0), full / 2, full, full))


@pytest.mark.parametrize("kind", MUTATIONS)
def test_a_mutation_keeps_cloud_and_truth_together(kind: str) -> None:
    whole = small()
    mutant = MUTATIONS[kind](np.random.default_rng(5), whole)
    points = mutant.points / (1000.0 if kind == "mm" else 1.0)
    nearest = cKDTree(points).query(mutant.truth.wall)[0]
    assert np.quantile(nearest, 0.5 if kind == "thinned" else 1.0) < (0.5 if kind == "thinned" else 1e-6)
    start, end = mutant.truth.span
    assert 25.0 < end - start <= 60.0
    at = mutant.truth.station[cKDTree(mutant.truth.axis).query(mutant.truth.wall)[1]]
    assert at.min() >= start
    assert at.max() <= end
    expected = {"thinned": 0.1, "strays": 1 / 0.9, "second": 1.6}.get(kind, 1.0)
    inside = np.sum((whole.points[:, 0] - 10 > start - 2) & (whole.points[:, 0] - 10 < end + 2))
    assert 0.85 * expected < len(points) / inside < 1.2 * expected


def test_a_mirror_exchanges_the_sides_and_a_turn_leans_by_up_to_15_degrees() -> None:
    whole, rng = small(), np.random.default_rng(2)
    mirrored = MUTATIONS["mirrored"](rng, whole)
    assert (mirrored.points[:, 0] < 0.0).all()
    assert mirrored.truth.axis[0, 0] == -whole.truth.axis[0, 0]
    aside = replace(whole, truth=replace(whole.truth, middle=0.03))
    assert MUTATIONS["mirrored"](rng, aside).truth.middle == -0.03
    leans, yaws = [], []
    for _ in range(40):
        turned = MUTATIONS["rotated"](rng, whole)
        along = turned.truth.axis[-1] - turned.truth.axis[0]
        leans.append(np.degrees(np.arcsin(abs(along[2]) / np.linalg.norm(along))))
        yaws.append(np.arctan2(along[1], along[0]))
        assert np.isnan(turned.truth.height).all()
    assert 10.0 < max(leans) <= 15.0 + 1e-9
    assert np.ptp(yaws) > 5.0


def test_spoilt_poses_are_off_by_what_they_say(tmp_path: Path) -> None:
    lines = [f"1700000000.{5000 * k:06d} {k} 0 0 0 0 {np.sin(0.1)} {np.cos(0.1)}" for k in range(5)]
    (tmp_path / "groundtruth.tum").write_text("\n".join(lines) + "\n")
    true = load_trajectory(tmp_path / "groundtruth.tum")
    moved = load_trajectory(spoil_poses(tmp_path, "late", late(0.1)))
    np.testing.assert_allclose(moved.time - true.time, 0.1, atol=1e-6)
    turned = load_trajectory(spoil_poses(tmp_path, "pitch", pitched))
    np.testing.assert_allclose(np.degrees((true.attitude.inv() * turned.attitude).magnitude()), 3.0, atol=1e-6)
    (tmp_path / "groundtruth.tum").rename(tmp_path / "groundtruth_vlp16.tum")
    turned = load_trajectory(spoil_poses(tmp_path, "roll", rolled, "vlp16"))
    np.testing.assert_allclose(
        np.degrees((true.attitude.inv() * turned.attitude).as_rotvec()), [[2, 0, 0]] * 5, atol=1e-6
    )
    (tmp_path / "groundtruth_vlp16.tum").rename(tmp_path / "groundtruth.tum")
    rows = np.loadtxt(spoil_poses(tmp_path, "wxyz", scalar_first))
    np.testing.assert_allclose(rows[0, 4:], [np.cos(0.1), 0, 0, np.sin(0.1)], atol=1e-9)


def test_troubles_are_made_once_and_say_what_to_name(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    words = ["troubles", "--out", str(tmp_path), "--only", "room"]
    assert make.main(words) == 0
    made = (tmp_path / "room.laz").stat().st_mtime_ns
    assert make.main(words) == 0
    assert (tmp_path / "room.laz").stat().st_mtime_ns == made
    (case,) = find_cases(tmp_path)
    truth = load_truth(case)
    assert (truth.expect, truth.cause, case.kind) == ("refused", ("room",), "bad")
    assert make.main(["troubles", "--out", str(tmp_path), "--only", "moon"]) == 2
    assert "no trouble 'moon'" in capsys.readouterr().err


def test_an_arch_with_outliers_is_right_and_is_judged_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder, out = tmp_path / "set", tmp_path / "out"
    rng = np.random.default_rng(8)
    site = bore(Alignment(2.0, 300.0, 0.0, (700.0, 20.0, 5.0)), length=16.0)
    seen = site.scanned(rng, spacing=0.08)
    low, high = seen.point.min(axis=0) - 3.0, seen.point.max(axis=0) + 3.0
    strays = rng.uniform(low, high, (len(seen.point) // 100, 3))
    write_laz(folder / "arch.laz", np.concatenate([seen.point, strays]))
    write_truth(folder / "arch_truth.npz", "arch", site.truth(rng, seen))
    words = [str(folder), "--out", str(out)]
    assert judge(words) == 0
    printed = capsys.readouterr().out
    assert "| arch | right |" in printed, printed
    row = out / "rows" / "arch.json"
    assert any("scattered" in cut for cut in json.loads(row.read_text())["removed"])
    before = row.stat().st_mtime_ns
    assert judge(words) == 0
    assert row.stat().st_mtime_ns == before


@pytest.mark.slow
def test_cases_judged_side_by_side_have_the_rows_of_those_judged_in_turn(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    truth = {"axis": np.zeros((2, 3)), "wall": np.empty((0, 3)), "span": (0.0, 1.0), "width": np.nan}
    for name in ("a", "b", "c"):
        write_laz(tmp_path / "set" / f"{name}.laz", rng.uniform(0.0, (30.0, 20.0, 0.01), (4000, 3)))
        write_truth(tmp_path / "set" / f"{name}_truth.npz", "bare", {**truth, "expect": "refused", "cause": ["plane"]})
    for jobs in ("1", "2"):
        assert judge([str(tmp_path / "set"), "--out", str(tmp_path / jobs), "--jobs", jobs]) == 0
    one, two = (json.loads((tmp_path / jobs / "dirty.json").read_text())["rows"] for jobs in ("1", "2"))
    for row in (*one, *two):
        assert row.pop("seconds") > 0.0
        assert row.pop("memory") > 0.0
    assert one == two
    assert [row["verdict"] for row in two] == ["refused"] * 3
    assert judge([str(tmp_path / "set"), "--out", str(tmp_path / "3"), "--jobs", "0"]) == 2


def test_mutations_can_be_made_in_parts(tmp_path: Path) -> None:
    points = small()
    write_laz(tmp_path / "set" / "box.laz", points.points)
    known = {name: getattr(points.truth, name) for name in ("axis", "wall", "span", "axis_above_floor", "width")}
    write_truth(tmp_path / "set" / "box_truth.npz", "box", known)
    words = ["mutations", str(tmp_path / "set"), "--seed", "4", "--count"]
    assert make.main([*words, "3", "--out", str(tmp_path / "whole")]) == 0
    assert make.main([*words, "1", "--first", "2", "--out", str(tmp_path / "part")]) == 0
    (part,) = (tmp_path / "part").glob("*.laz")
    assert part.name.startswith("002-")
    assert part.read_bytes() == (tmp_path / "whole" / part.name).read_bytes()


def test_cases_of_surveys_are_judged_by_the_wall_that_the_carrier_could_see(tmp_path: Path) -> None:
    words = ["surveys", "--out", str(tmp_path), "--truths", "platform", "--length", "18", "--seed", "2"]
    assert make.main([*words, "--sensors", "vlp16", "--poses", "given", "control"]) == 0
    first, second = find_cases(tmp_path)
    assert (first.kind, second.kind) == ("vlp16-control", "vlp16-given")
    assert first.source == tmp_path / "survey-platform-2" / "survey_vlp16.bag"
    assert first.words[-3:] == [f"{tmp_path}/survey-platform-2/calibration_vlp16.yaml", "--provenance", "simulated"]
    truth = load_truth(second)
    assert len(truth.sleepers) == len(np.unique(truth.sleepers, axis=0)) > 20
    assert (truth.track, truth.bulge) == ("single", ("aside", "width", "height"))
    # The wall behind the platform stands 3 m further out, so the middle between both walls 1.5 m.
    middle = np.broadcast_to(truth.middle, len(truth.axis))
    assert np.median(middle[np.abs(truth.station - 9.0) < 1.5]) == pytest.approx(1.5, abs=0.1)
    assert np.median(middle[truth.station < 3.0]) == pytest.approx(0.0, abs=0.1)
    # The platform hides the foot of the wall behind it: 1 m high from 1.75 to about 5.8 m, seen from 1.6 m.
    station = truth.station[cKDTree(truth.axis).query(truth.wall)[1]]
    tangent = np.gradient(truth.axis, truth.station, axis=0)[cKDTree(truth.axis).query(truth.wall)[1]]
    offset = truth.wall - truth.axis[cKDTree(truth.axis).query(truth.wall)[1]]
    left = np.einsum("ij,ij->i", offset, np.cross([0.0, 0.0, 1.0], tangent))
    beside = (station > 0.45 * 18) & (station < 0.55 * 18) & (left > 4.0)
    low = offset[:, 2] + truth.axis_above_floor.mean() < 0.95
    assert beside.sum() > 50
    assert not (beside & low).any()
    assert (~beside & low).any()


def test_a_niche_is_no_wall_and_a_lay_by_is() -> None:
    station = np.arange(0.0, 40.1, 0.25)
    truth = {
        "station": station, "position": np.stack([station, 0 * station, 0 * station], axis=1),
        "tangent": np.tile([1.0, 0.0, 0.0], (len(station), 1)),
        "aside": np.where(np.abs(station - 10.0) < 1.0, 0.6, 0.0),
    }  # fmt: skip
    truth["width_smooth"] = 5.0 + truth["aside"]
    places = np.array([[10.0, 3.1, 0.0], [11.05, 2.8, 0.0], [10.0, -2.5, 0.0], [10.0, 1.0, 2.0], [20.0, 2.6, 0.0]])
    near = np.rint(places[:, 0] / 0.25).astype(int)
    assert _in_niche(truth, places, near).tolist() == [True, True, False, False, False]
    truth["aside"] = np.where(np.abs(station - 10.0) < 4.0, 0.6, 0.0)
    assert not _in_niche(truth, places, near).any()


def test_a_lidar_sees_what_lies_in_its_field() -> None:
    way = np.tile([0.0, 1.0, 0.0], (4, 1))
    ray = np.array([[0.5, 2.0, 0.1], [0.0, -2.0, 0.1], [0.0, 2.0, 1.0], [2.0, 0.1, 0.0]])  # ahead, behind, up, aside
    assert _in_field(ray, way, "vlp16").tolist() == [True, True, False, True]
    assert _in_field(ray, way, "avia").tolist() == [True, False, True, False]


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_no_trouble_is_built_wrong_without_a_word(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert make.main(["troubles", "--out", str(tmp_path / "set"), "--seed", "7"]) == 0
    assert judge([str(tmp_path / "set"), "--out", str(tmp_path / "out")]) == 0
    rows = json.loads((tmp_path / "out" / "dirty.json").read_text())["rows"]
    wrong = {row["name"]: row["verdict"] for row in rows if row["verdict"] not in ("right", "warned", "refused")}
    assert not wrong, capsys.readouterr().out
