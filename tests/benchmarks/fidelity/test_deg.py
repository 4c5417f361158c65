from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.categories import sensor
from benchmarks.fidelity.derive.degeneracy import alias_ratios, information, localised_stations
from benchmarks.fidelity.faults import Fault, Site, put_in
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import judged, raw

SMOOTH = replace(tube.Tube(), bend=np.inf, grade=0.0, variation=0.0, depth=0.0, track=False)


def test_a_straight_smooth_tube_tells_nothing_along_its_axis():
    frames = information(tube.case(SMOOTH, sigma=1e-4, beams=2000), True)
    assert np.median(frames.axial) < 1e-3
    axis = SMOOTH.frames([9.0])[1][0]
    assert np.median(np.abs(frames.weakest @ axis)) > 0.999
    assert np.median(frames.translation.sum(axis=1)) == pytest.approx(1.0, abs=1e-6)


def test_sleepers_tell_the_axis():
    bare, laid = (tube.case(replace(SMOOTH, track=laid), sigma=1e-3, beams=2000) for laid in (False, True))
    assert np.median(information(laid, True).axial) > 5 * np.median(information(bare, True).axial)


def test_a_scan_fits_as_well_elsewhere_in_a_smooth_tube_and_nowhere_else_in_a_wavy_one():
    smooth, wavy = (tube.case(replace(SMOOTH, variation=v), sigma=1e-3, beams=2000) for v in (0.0, 0.05))
    assert np.median(alias_ratios(smooth, True)) < 1.2
    assert np.median(alias_ratios(wavy, True)) > 3.0


def _planar(path, walls, lining="smooth"):
    station = np.linspace(0.0, 20.0, 81)
    centre = np.column_stack([station, np.zeros(81)])
    polylines = {f"{side}_{lining}": wall for side, wall in zip(("left", "right"), walls, strict=True)}
    np.savez(path, station=station, centre=centre, tangent=np.tile([1.0, 0.0], (81, 1)), **polylines)
    return Case(replace(judged().candidate, tunnel=path))


def test_a_planar_scan_is_lost_between_smooth_walls_and_found_between_pilasters(tmp_path):
    straight = [np.array([[0.0, side], [20.0, side]]) for side in (2.5, -2.5)]
    assert not localised_stations(_planar(tmp_path / "smooth.npz", straight)).any()
    x = np.repeat(np.arange(0.0, 20.5, 1.0), 2)
    step = np.tile([0.0, 0.5, 0.5, 0.0], len(x) // 4 + 1)[: len(x)]
    stepped = [np.column_stack([x, side * (2.0 + step)]) for side in (1, -1)]
    pilasters = _planar(tmp_path / "pockets.npz", stepped, "pockets")
    assert localised_stations(pilasters).mean() > 0.5
    assert raw("deg_planar_axial_info", pilasters) == localised_stations(pilasters).mean()


def test_a_scan_near_the_cut_counts_by_the_probability_that_it_lies_beyond(monkeypatch):
    """One standard deviation above and below the cut: 84 % and 16 % of a normal distribution."""
    deviation, weakest = 0.05, np.full((20, 3), 1.0)  # of log10
    scans = {real: SimpleNamespace(axial=np.full(20, 10.0 ** (sign * deviation) / 10.0), translation=weakest)
             for real, sign in ((True, 1.0), (False, -1.0))}  # fmt: skip
    monkeypatch.setattr(sensor.degeneracy, "information", lambda case, real: scans[real])
    assert sensor.deg_landmark_diff(None).value == pytest.approx(100.0 * (0.8413 - 0.1587), abs=0.01)


def test_half_of_the_beams_are_as_informed():
    whole = tube.case(sigma=0.03, beams=8000)
    half = put_in(Site(whole, np.random.default_rng(7)), Fault("thinned", 0.5))
    full, thin = (np.median(information(case, True).axial) for case in (whole, half))
    assert thin == pytest.approx(full, rel=0.1)
