"""Tubes judged against the right one, each once for all test modules of the surface categories."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import trimesh

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.registry import Value, compute_metric
from tests.benchmarks.fidelity import tube

BEAMS = 2000
DEFAULT, BARE, PLAIN = tube.Tube(), tube.Tube(depth=0.0, track=False), tube.Tube(track=False)
SHORT = tube.Tube(length=12.0)


def lasting(make: Callable[..., Case]) -> Callable[..., Case]:
    """Makes each case once, and has each of its values computed once."""

    @cache
    def once(*args, **changes) -> Case:
        case = make(*args, **changes)
        case.cache["values"] = {}
        return case

    return once


@lasting
def against(right: tube.Tube, heard: bool = False, box: tuple[float, ...] = (), beams: int = 6000, **changes) -> Case:
    """A tube with other dimensions judged against a right one; `heard` by its recording alone, of so many beams.

    `box` puts in boxes, each by its size along, left and up and by the station, left and up of its middle.
    """
    if heard:
        return replace(against(right, False, box, beams, **changes), truth=None, cache={})
    if box:
        bodies = [tube.box(right, *box[k + 3 : k + 6], box[k : k + 3]) for k in range(0, len(box), 6)]
        return tube.corrupted(against(right, beams=beams, **changes), extra=trimesh.util.concatenate(bodies))
    return tube.case(right, replace(right, **changes), beams=beams)


@lasting
def judged(**changes) -> Case:
    """The default tube's recording against a tube with other dimensions; without any, against itself."""
    return tube.case(tube.Tube(), replace(tube.Tube(), **changes), beams=BEAMS)


@lasting
def obstructed(size: float = 0.5) -> Case:
    """A cube on the floor in the middle of an otherwise right tube, beside the track."""
    right = judged()
    box = trimesh.creation.box((size, size, 2.0))
    box.apply_translation(tube.Tube().point(9.0, 1.9, -1.2)[0])
    return Case(replace(right.candidate, extra=box), right.hold, None, right.truth)


def measure(id: str, case: Case) -> Value:
    """One metric by its id, as the suite computes it."""
    known = case.cache.get("values", {})
    if id not in known:
        known[id] = compute_metric(case, table.load()[id])
    return known[id]


def raw(id: str, case: Case) -> float:
    """Its raw value; fails where there is none."""
    found = measure(id, case)
    assert found.value is not None, f"{id}: {found.reason}"
    return found.value


def scores(category: str, case: Case) -> dict[str, float | None]:
    """Scores of a category's scored metrics."""
    rows = table.load()
    ids = [id for id, metric in rows.items() if metric.category == category and metric.scored]
    return {id: scoring.score_one(rows[id], measure(id, case)).score for id in ids}


def category(name: str, case: Case) -> float:
    """Mean score of the metrics of a category that have one."""
    known = [score for score in scores(name, case).values() if score is not None]
    return sum(known) / len(known)
