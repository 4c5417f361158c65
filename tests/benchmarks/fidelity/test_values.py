"""Every value of a tube with many faults is what it was, against its truth and by its recording alone.

Whoever changes what a metric measures on purpose writes the table anew, as `tests.recorded` has it, and says why.
"""

from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import clouds, distances
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.windows.judge import worst_windows
from tests.benchmarks.fidelity import tube, tubescene
from tests.benchmarks.fidelity.judged import SHORT, kept, measure
from tests.recorded import check

TABLE = Path(__file__).with_name("values.csv")
RIGHT = tube.Tube(length=11.0, bend=90.0)
FAULTS = (
    Fault("noise", 0.002), Fault("wall", 0.06, 4.0, 2.0), Fault("roll", 0.004), Fault("along", 0.06, 4.0, 3.0),
    Fault("missing", 0.2), Fault("gauge", 0.003), Fault("rails", 0.01, 2.0, 3.0), Fault("lift", 0.01, 6.0, 2.0),
    Fault("box", 0.3, 6.0, 2.0),
)  # fmt: skip
IN_MEMORY = [id for id, row in table.load().items() if row.category not in ("SCN", "PAR")]
BY_TRUTH = ("CEN", "SEC", "TOP", "F2D", "F3D", "NAV", "LIN", "TRK")  # the others do not read a truth that is there


@cache
def corrupted(known: bool) -> Case:
    beams = 1500 if known else 6000  # so many show sections and ground by themselves
    case = tube.case(RIGHT, replace(RIGHT, width=5.62, depth=0.11), beams=beams)
    fit = tube.hold(RIGHT, beams=300, seed=1)
    for fault in FAULTS:
        case = put_in(Site(case, np.random.default_rng(0)), fault)
    return replace(case, fit=fit, truth=case.truth if known else None, cache={})


def values(known: bool) -> dict[str, dict[str, float | None]]:
    """Value, upper end of its interval and number of samples by metric; value and place of the worst windows."""
    found = {}
    for id in IN_MEMORY if known else (id for id in IN_MEMORY if table.load()[id].category in BY_TRUTH):
        one = measure(id, corrupted(known))
        found[id] = {"value": one.value, "end": one.interval[1] if one.interval else None, "n": one.n}
    for one in map(asdict, worst_windows(corrupted(known))):
        found[f"window {one['id']} {one['source']}"] = {name: one[name] for name in ("value", "start", "judged")}
    return found


@pytest.mark.parametrize("known", [True, False], ids=["known", "heard"])
def test_every_value_is_what_it_was(known: bool) -> None:
    check(TABLE, "known" if known else "heard", values(known))


def test_no_m3c2_distance_depends_on_how_a_normal_is_rounded(monkeypatch: pytest.MonkeyPatch) -> None:
    flat = clouds.real_planes(corrupted(True))
    turned = replace(flat, normal=flat.normal * (1.0 + 3e-16 * np.random.default_rng(0).normal(size=flat.normal.shape)))
    before = distances.m3c2_distances(corrupted(True)).distance
    monkeypatch.setattr(distances, "real_planes", lambda case: turned)
    np.testing.assert_allclose(distances.m3c2_distances(replace(corrupted(True), cache={})).distance, before, atol=1e-9)


@pytest.mark.parametrize("known", [True, False], ids=["known", "heard"])
def test_what_values_are_made_of_is_what_it_was(known: bool) -> None:
    """Kept results of all derivations, which a percentile may hide."""
    values(known)
    check(TABLE, "derived" if known else "derived heard", kept(corrupted(known)), 1e-3)


@pytest.mark.parametrize("length", [8.0, 14.0])
def test_where_counts_and_lengths_differ_every_value_is_what_it_was(length: float) -> None:
    case = tube.case(RIGHT, replace(RIGHT, length=length), beams=1500)
    rows = table.load()
    ids = [id for id in IN_MEMORY if rows[id].category in ("CEN", "SEC", "LIN", "TRK", "NAV")]
    check(TABLE, f"length {length:g}", {id: measure(id, case).value for id in ids})


def test_every_value_of_a_scene_in_mujoco_is_what_it_was(tmp_path) -> None:
    folder = tubescene.write(tmp_path / "tube", SHORT, panels_off=0.03)
    text = (folder / "scene.xml").read_text()
    (folder / "scene.xml").write_text(text.replace('name="sleeper_0003"', 'name="plank"'))
    case = Case(load_candidate(folder))
    ids = [
        id
        for id, row in table.load().items()
        if row.category == "SCN" and id not in ("mj_step_rate", "mj_version_match")
    ]
    check(TABLE, "scene", {id: round(measure(id, case).value, 5) for id in ids}, 1e-3)
    check(TABLE, "derived scene", kept(case), 1e-3)
