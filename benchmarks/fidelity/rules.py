"""The three rules by which simulated surveys may move a threshold.

- *Null rule*: the null tube gets half marks or more though it is plainly worse than the truth. The good end moves to
  half of the null tube's error, not below 1.5 times the truth's own, nor below what the references resolve, nor below
  five times what a change that changes nothing moves it; the bad end to three times the good one, so that a tenth more
  or less of either never decides.
- *Good end*: the truth itself, scored as a candidate, does not reach 100; it moves to 1.5 times what the truth reaches.
- *Bad end*: a control's bold dose lowers a category by less than it must; it moves, in the metrics of that category
  that plainly see the control, to what the control reaches.
"""

import numpy as np

from benchmarks.fidelity import scoring
from benchmarks.fidelity.controls import catalogue
from benchmarks.fidelity.evidence import Survey, Values, distances, ends, rounded
from benchmarks.fidelity.table import Metric

WIDEN = 1.5
PLAIN = 2.0  # times the distance of the truth (or reconstruction) at which a null tube or control is plainly seen
APART = 1.2  # times the reconstruction from which a null tube has its axis: what both share is no fault of a tube
HALF = 0.5  # of the null tube's error
STEEPEST = 3.0  # times the good end that a bad end is never nearer than
STILL = 5.0  # times what an invariance control moves a metric: it then costs a tenth of the marks at most
RESOLVED = {
    "m": 0.01,
    "%": 0.3,
    "1": 0.01,
    "deg": 0.1,
    "mm": 0.5,
    "nat": 0.1,
    "count": 0.5,
}  # a third of a LiDAR's range noise


def null_ends(row: Metric, surveys: list[Survey]) -> tuple[float, float, str] | None:
    """Good and bad end where the null tube would get half marks or more, and why; else `None`."""
    sides = [distances(row, [getattr(s, name) for s in surveys]) for name in ("ceiling", "null", "base")]
    if not _measured(row) or not all(sides):
        return None
    truth, null, base = max(sides[0]), float(np.median(sides[1])), float(np.median(sides[2]))
    resolved = RESOLVED.get(row.unit, 0.0)
    if null > np.mean(ends(row.map)) or null < max(PLAIN * truth, PLAIN * resolved, APART * base):
        return None
    least = max(WIDEN * truth, HALF * null, resolved, STILL * _restless(row, surveys))
    good = min(rounded(least), ends(row.map)[0])
    reason = f"null rule: the null tube's {null:.3g} gets half marks or more, the truth reaches {truth:.3g}"
    return good, min(rounded(STEEPEST * max(good, least)), ends(row.map)[1]), reason


def good_end(row: Metric, surveys: list[Survey]) -> tuple[float, str] | None:
    """Where the good end belongs and why; `None` where the truth reaches it."""
    if not _measured(row):
        return None
    worst = max(distances(row, [survey.ceiling for survey in surveys]), default=0.0)
    if worst <= ends(row.map)[0]:
        return None
    return rounded(WIDEN * worst), f"the truth itself comes no nearer than {worst:.3g}; 1.5 times that"


def bad_ends(rows: dict[str, Metric], surveys: list[Survey]) -> dict[str, tuple[float, str]]:
    """Where bad ends belong and why, by metric, for every control that lowers a category too little."""
    found: dict[str, tuple[float, str]] = {}
    for survey in surveys:
        before = scoring.score_all(survey.base, rows=rows).categories
        for (control, dose), values in survey.spoilt.items():
            after = scoring.score_all(values, rows=rows).categories
            for category, asked in catalogue.load()[control].falls.items():
                if (before[category] or 0.0) - (after[category] or 0.0) >= asked:
                    continue
                reason = f"{control} at {dose:g} must lower {category} by {asked:g}"
                for row in rows.values():
                    if row.category == category and (end := _seen(row, survey, values)) is not None:
                        least = min(end, found.get(row.id, (end, ""))[0])
                        found[row.id] = (least, f"{reason}; this is what it reaches on {survey.name}")
    return found


def _measured(row: Metric) -> bool:
    return row.scored and row.map.kind in "DUB" and bool(set(row.evidence) & set("HT"))


def _restless(row: Metric, surveys: list[Survey]) -> float:
    """How far a change that changes nothing moves a metric at most."""
    moves = [
        abs(changed - base)
        for survey in surveys
        for base in distances(row, [survey.base])
        for changed in distances(row, list(survey.same.values()))
    ]
    return max(moves, default=0.0)


def _seen(row: Metric, survey: Survey, spoilt: Values) -> float | None:
    """The distance that a control reaches on a metric that plainly sees it and does not yet score 0 for it."""
    if not row.scored or len(near := distances(row, [survey.base, survey.ceiling, spoilt])) < 3:
        return None
    base, ceiling, reached = near
    good, bad = ends(row.map)
    if reached < PLAIN * max(base, ceiling) or not STEEPEST * good < reached < bad:
        return None
    return rounded(reached)
