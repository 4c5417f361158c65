"""Tubes judged against the right one, each once for all test modules of the surface categories."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import trimesh

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import Fault, Site, put_in
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
def against(
    right: tube.Tube, heard: bool = False, box: tuple[float, ...] = (), fault: tuple = (), beams: int = 6000, **changes
) -> Case:
    """A tube with other dimensions judged against a right one; `heard` by its recording alone, of so many beams.

    `box` puts in boxes, each by its size along, left and up and by the station, left and up of its middle; `fault` is
    that of the suite by its kind, size and place.
    """
    if heard:
        return replace(against(right, False, box, fault, beams, **changes), truth=None, cache={})
    if fault:
        return put_in(Site(against(right, False, box, beams=beams, **changes)), Fault(*fault))
    if box:
        bodies = [tube.box(right, *box[k + 3 : k + 6], box[k : k + 3]) for k in range(0, len(box), 6)]
        return tube.corrupted(against(right, beams=beams, **changes), extra=trimesh.util.concatenate(bodies))
    return tube.case(right, replace(right, **changes), beams=beams)


judged = partial(against, DEFAULT, beams=BEAMS)  # the default tube's recording, against one of other dimensions
obstructed = partial(judged, box=(0.5, 0.5, 2.0, 9.0, 1.9, -1.2))  # a cube on the floor beside the track


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


def kept(case: Case) -> dict[str, Any]:
    """Results derived of a case so far, by the names of functions and arguments; no tools, no clocks of metrics."""
    caches = [case.cache, *(one.cache for one in (case.hold, case.truth) if one is not None)]
    known = {".".join(map(_word, key)): one for results in caches for key, one in results.items() if not _is_tool(one)}
    return {name.replace("benchmarks.fidelity.", ""): one for name, one in known.items() if ".categories." not in name}


def _word(part: object) -> str:
    return str(part) if isinstance(part, str | int | float) else type(part).__name__


def _is_tool(value: object) -> bool:
    return callable(value) or type(value).__name__ in ("Geoms", "Stepper")
