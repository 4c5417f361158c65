"""Every value of a tube with many faults is what it was, against its truth and by its recording alone (slow).

Whoever changes what a metric measures on purpose writes the table anew, and says why:
`python -m tests.benchmarks.fidelity.test_values`.
"""

import csv
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import clouds, distances
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.windows.judge import worst_windows
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure

TABLE = Path(__file__).with_name("values.csv")
RIGHT = tube.Tube(length=11.0, bend=90.0)
FAULTS = (
    Fault("noise", 0.002), Fault("wall", 0.06, 4.0, 2.0), Fault("roll", 0.004), Fault("along", 0.06, 4.0, 3.0),
    Fault("missing", 0.2), Fault("gauge", 0.003), Fault("rails", 0.01, 2.0, 3.0), Fault("lift", 0.01, 6.0, 2.0),
    Fault("box", 0.3, 6.0, 2.0),
)  # fmt: skip
IN_MEMORY = [id for id, row in table.load().items() if row.category not in ("SCN", "PAR")]


@cache
def corrupted(known: bool) -> Case:
    beams = 1500 if known else 6000  # so many show sections and ground by themselves
    case = tube.case(RIGHT, replace(RIGHT, width=5.62, depth=0.11), beams=beams)
    fit = tube.hold(RIGHT, beams=300, seed=1)
    for fault in FAULTS:
        case = put_in(Site(case, np.random.default_rng(0)), fault)
    return replace(case, fit=fit, truth=case.truth if known else None, cache={})


def values(known: bool) -> dict[str, tuple[float | None, float | None, int]]:
    """Value, upper end of its interval and number of samples by metric; value and place of the worst windows."""
    found = {}
    for id in IN_MEMORY:
        one = measure(id, corrupted(known))
        found[id] = one.value, one.interval[1] if one.interval else None, one.n
    for one in map(asdict, worst_windows(corrupted(known))):
        found[f"window {one['id']} {one['source']}"] = one["value"], one["start"], round(1e3 * one["judged"])
    return found


def written(known: bool) -> dict[str, dict[str, str]]:
    with TABLE.open(newline="") as file:
        return {row["id"]: row for row in csv.DictReader(file) if row["known"] == str(known)}


@pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_value_is_what_it_was(known: bool) -> None:
    rows, now = written(known), values(known)
    assert list(rows) == list(now)
    for id, (value, end, count) in now.items():
        for key, one in (("value", value), ("end", end)):
            expected = float(rows[id][key]) if rows[id][key] else None
            assert one == (None if expected is None else pytest.approx(expected, rel=1e-4, abs=1e-7)), (id, key)
        assert str(count) == rows[id]["n"], id


def test_no_m3c2_distance_depends_on_how_a_normal_is_rounded(monkeypatch: pytest.MonkeyPatch) -> None:
    flat = clouds.real_planes(corrupted(True))
    turned = replace(flat, normal=flat.normal * (1.0 + 3e-16 * np.random.default_rng(0).normal(size=flat.normal.shape)))
    before = distances.m3c2_distances(corrupted(True)).distance
    monkeypatch.setattr(distances, "real_planes", lambda case: turned)
    np.testing.assert_allclose(distances.m3c2_distances(replace(corrupted(True), cache={})).distance, before, atol=1e-9)


if __name__ == "__main__":
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("known", "id", "value", "end", "n"))
        writer.writerows((known, id, *one) for known in (True, False) for id, one in values(known).items())
