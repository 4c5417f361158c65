import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.dirty.__main__ import main as judge
from benchmarks.dirty.truth import find_cases, load_truth
from tests.benchmarks.dirty.clouds.air import Alignment, Arch, prism, surface_of
from tests.benchmarks.dirty.clouds.files import write_laz, write_truth
from tests.benchmarks.dirty.clouds.scanner import choose
from tests.benchmarks.dirty.clouds.site import bore
from tests.benchmarks.dirty.clouds.troubles import make_troubles


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


def test_a_trouble_says_what_to_name(tmp_path: Path) -> None:
    make_troubles(tmp_path, only=("room",))
    (case,) = find_cases(tmp_path)
    truth = load_truth(case)
    assert (truth.expect, truth.cause, case.kind) == ("refused", ("room",), "trouble")


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
@pytest.mark.timeout(7200)
def test_no_trouble_is_built_wrong_without_a_word(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    make_troubles(tmp_path / "set", 7)
    assert judge([str(tmp_path / "set"), "--out", str(tmp_path / "out")]) == 0
    rows = json.loads((tmp_path / "out" / "dirty.json").read_text())["rows"]
    wrong = {row["name"]: row["verdict"] for row in rows if row["verdict"] not in ("right", "warned", "refused")}
    assert not wrong, capsys.readouterr().out
