"""Sets thresholds from simulated surveys with known truth, before any real recording is scored.

A score is 100 at the noise floor and falls in a straight line to 0 at the bad end. The noise floor of a metric that has
a reference is what the truth itself, scored as a candidate, comes to on the worst of the surveys: a perfect
reconstruction has 100, and one that is merely good has not. Three rules set the ends that the floor then replaces or
leaves:

- *Null rule*: the null tube gets half marks or more though it is plainly worse than the truth. The good end moves to
  half of the null tube's error, not below 1.5 times the truth's own, nor below what the references resolve, nor below
  five times the move under an invariance; the bad end to three times the good one, so that a tenth more or less of
  either never decides.
- *Good end*: the truth itself, scored as a candidate, does not reach 100; it moves to 1.5 times what the truth reaches.
- *Bad end*: a control's bold dose lowers a category by less than it must; it moves, in the metrics of that category
  that plainly see the control, to what the control reaches.
"""

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks.fidelity import judge, scoring, table
from benchmarks.fidelity.controls.catalogue import INVARIANCES, load_controls
from benchmarks.fidelity.controls.runner import OUTCOME_SCHEMA, is_bold, list_jobs
from benchmarks.fidelity.files import FidelityError, read_json, write_json
from benchmarks.fidelity.registry import Value, load_values
from benchmarks.fidelity.table import Map, Metric
from benchmarks.fidelity.windows.commands import set_limits
from benchmarks.fidelity.windows.measures import LIMITS, STANDARD_SENSOR

DECISIONS = Path(__file__).with_name("decisions.csv")
Values = dict[str, Value]


@dataclass(frozen=True)
class Survey:
    """Values of one simulated survey.

    Attributes:
        name: Name of its folder.
        base: Values of the reconstruction.
        ceiling: Values of the truth as candidate.
        null: Values of the null tube.
        spoilt: Values by control and bold dose.
        same: Values by invariance control.
    """

    name: str
    base: Values
    ceiling: Values
    null: Values
    spoilt: dict[tuple[str, float], Values] = field(default_factory=dict)
    same: dict[str, Values] = field(default_factory=dict)


def load_survey(folder: Path) -> Survey:
    """Reads the results of `controls` in a folder.

    Raises:
        FidelityError: Nothing, or without a truth.
    """
    values = read_json(folder / "values.json", judge.VALUES_SCHEMA)["values"]
    if "ceiling" not in values:
        raise FidelityError(f"{folder}: was judged without --truth, so it has no ceiling to calibrate by")
    base, ceiling, null = (load_values(values[name]) for name in ("base", "ceiling", "null"))
    survey = Survey(folder.name, base, ceiling, null)
    for job in list_jobs():
        path = folder / "controls" / f"{job.name}.json"
        if path.exists() and is_bold(job):
            values = load_values(read_json(path, OUTCOME_SCHEMA)["values"])
            if job.control in INVARIANCES:
                survey.same[job.control] = values
            else:
                survey.spoilt[job.control, job.dose] = values
    return survey


def draft_table() -> dict[str, Metric]:
    """Return the table without any calibration."""
    with table.METRICS.open(newline="") as file:
        rows = {row["id"]: row for row in csv.DictReader(file)}
    return {
        id: replace(row, map=table.parse_map(rows[id]["map"]), role=rows[id]["role"])
        for id, row in table.load().items()
    }


def decided_rows(rows: dict[str, Metric]) -> dict[str, tuple[Metric, str]]:
    """Return the rows that `decisions.csv` changes by hand, with its reasons."""
    with DECISIONS.open(newline="") as file:
        return {
            row["id"]: (replace(rows[row["id"]], role=row["role"], map=table.parse_map(row["map"])), row["reason"])
            for row in csv.DictReader(file)
        }


def ideal_distance(map: Map, value: float) -> float:
    """Return the distance from the ideal: 0 for D, 1 (or a larger good end) for U, the target for B."""
    if map.kind == "U":
        return max(max(1.0, map.good) - value, 0.0)
    return abs(value - map.target) if map.kind == "B" else abs(value)


def map_ends(map: Map) -> tuple[float, float]:
    """Return good and bad end as distances from the ideal."""
    if map.kind == "U":
        top = max(1.0, map.good)
        return top - map.good, top - map.bad
    return map.good, map.bad


def move_ends(map: Map, good: float, bad: float) -> Map:
    """Return the map with ends at distances from the ideal."""
    if map.kind == "U":
        top = max(1.0, map.good)
        return replace(map, good=round(top - good, 6), bad=round(top - bad, 6))
    return replace(map, good=good, bad=bad)


def two_digits(value: float) -> float:
    """Rounds to two significant digits."""
    return float(f"{value:.2g}")


def ideal_distances(row: Metric, found: list[Values]) -> list[float]:
    """Return the distances of some candidates from the ideal, of those that have the metric."""
    known = [values[row.id].value for values in found]
    return [ideal_distance(row.map, value) for value in known if value is not None] if row.map.kind in "DUB" else []


# The rules by which surveys may move a threshold.

WIDEN = 1.5
PLAIN = 2.0  # times the distance of the truth (or reconstruction) at which a null tube or control is plainly seen
APART = 1.2  # times the reconstruction from which a null tube has its axis: what both share is no fault of a tube
HALF = 0.5  # of the null tube's error
STEEPEST = 3.0  # times the good end that a bad end is never nearer than
STILL = 5.0  # times what an invariance control moves a metric: it then costs a tenth of the marks at most
RESOLVED = {
    "m": 0.01, "m/100 m": 0.01, "%": 0.3, "1": 0.01, "deg": 0.1, "mm": 0.5, "nat": 0.1, "count": 0.5,
    "1/100 scans": 0.5,
}  # fmt: skip  # by unit: a third of a LiDAR's range noise
RESTLESS = 5.0  # points
FINEST = 1e-6  # what arithmetic may leave of no error at all


def null_rule(row: Metric, surveys: list[Survey]) -> tuple[float, float, str] | None:
    """Return good and bad end where the null tube would get half marks or more, and the reason; else `None`."""
    sides = [ideal_distances(row, [getattr(s, name) for s in surveys]) for name in ("ceiling", "null", "base")]
    if not _is_measured(row) or not all(sides):
        return None
    truth, null, base = max(sides[0]), float(np.median(sides[1])), float(np.median(sides[2]))
    resolved = RESOLVED.get(row.unit, 0.0)
    if null > np.mean(map_ends(row.map)) or null < max(PLAIN * truth, PLAIN * resolved, APART * base):
        return None
    least = max(WIDEN * truth, HALF * null, resolved, STILL * _restlessness(row, surveys))
    good = min(two_digits(least), map_ends(row.map)[0])
    reason = f"null rule: the null tube's {null:.3g} gets half marks or more, the truth reaches {truth:.3g}"
    return good, min(two_digits(STEEPEST * max(good, least)), map_ends(row.map)[1]), reason


def good_end_rule(row: Metric, surveys: list[Survey]) -> tuple[float, str] | None:
    """Return the good end that the truth needs and the reason; `None` where the truth reaches it."""
    if not _is_measured(row):
        return None
    worst = max(ideal_distances(row, [survey.ceiling for survey in surveys]), default=0.0)
    if worst <= map_ends(row.map)[0]:
        return None
    return two_digits(WIDEN * worst), f"the truth itself comes no nearer than {worst:.3g}; 1.5 times that"


def bad_end_rule(rows: dict[str, Metric], surveys: list[Survey]) -> dict[str, tuple[float, str]]:
    """Return bad ends and reasons, by metric, for every control that lowers a category too little."""
    ends: dict[str, tuple[float, str]] = {}
    for survey in surveys:
        before = scoring.score_all(survey.base, rows=rows).categories
        for (control, dose), values in survey.spoilt.items():
            after = scoring.score_all(values, rows=rows).categories
            for category, asked in load_controls()[control].falls.items():
                if (before[category] or 0.0) - (after[category] or 0.0) >= asked:
                    continue
                reason = f"{control} at {dose:g} must lower {category} by {asked:g}"
                for row in rows.values():
                    if row.category == category and (end := _reached_distance(row, survey, values)) is not None:
                        least = min(end, ends.get(row.id, (end, ""))[0])
                        ends[row.id] = (least, f"{reason}; this is what it reaches on {survey.name}")
    return ends


def noise_floor(row: Metric, surveys: list[Survey]) -> float | None:
    """Return the good end at which the truth itself has 100 on every survey; `None` without a reference.

    Rounded to three digits, away from the ideal. `None` also where a change that changes nothing, half of the beams for
    instance, would cost or bring more than `RESTLESS` points from there: the metric then keeps its wider end.

    Raises:
        FidelityError: The truth scores 0 somewhere, so that the metric tells nothing.
    """
    reached = ideal_distances(row, [survey.ceiling for survey in surveys]) if _is_measured(row) else []
    if not reached:
        return None
    floor = _round_up(max(reached))
    if floor >= map_ends(row.map)[1]:
        raise FidelityError(f"{row.id}: the truth itself comes no nearer than {max(reached):.3g} and scores 0")
    good = max(1.0, row.map.good) - floor if row.map.kind == "U" else floor
    honest = replace(row.map, good=good)
    moves = [
        abs(honest.score(changed) - honest.score(base))
        for survey in surveys
        for values in survey.same.values()
        if (base := survey.base[row.id].value) is not None and (changed := values[row.id].value) is not None
    ]
    return None if max(moves, default=0.0) > RESTLESS else good


def _round_up(value: float) -> float:
    if value <= FINEST:
        return FINEST
    least = value * (1.0 + 1e-9)  # rounding of floats is no error of the truth
    step = 10.0 ** (np.floor(np.log10(least)) - 2)
    return float(f"{step * np.ceil(least / step):.3g}")


def _is_measured(row: Metric) -> bool:
    return row.scored and row.map.kind in "DUB" and bool(set(row.evidence) & set("HT"))


def _restlessness(row: Metric, surveys: list[Survey]) -> float:
    """Return the largest move of a metric under a change that changes nothing."""
    moves = [
        abs(changed - base)
        for survey in surveys
        for base in ideal_distances(row, [survey.base])
        for changed in ideal_distances(row, list(survey.same.values()))
    ]
    return max(moves, default=0.0)


def _reached_distance(row: Metric, survey: Survey, spoilt: Values) -> float | None:
    """Return the distance that a control reaches on a metric that sees it and does not yet score 0 for it."""
    if not row.scored or len(near := ideal_distances(row, [survey.base, survey.ceiling, spoilt])) < 3:
        return None
    base, ceiling, reached = near
    good, bad = map_ends(row.map)
    if reached < PLAIN * max(base, ceiling) or not STEEPEST * good < reached < bad:
        return None
    return two_digits(reached)


# The command.

THRESHOLDS_SCHEMA = "subterra.fidelity-thresholds/1"
FEWEST_SURVEYS = 3


@dataclass(frozen=True)
class CalibrateConfig:
    """Place of the evidence.

    Attributes:
        runs: Output folders of `controls` on simulated surveys with `--truth`.
        out: File to write; the table takes its thresholds from there.
        fewest: Smallest number of surveys.
        floors: Set the noise floors alone; all other ends stay as they are.
        windows: Set the limits of windows instead, from output folders of `windows`.
        sensor: LiDAR of the recordings, for the limits of windows: os1, avia or vlp16.
    """

    runs: tuple[Path, ...]
    out: Path = table.THRESHOLDS
    fewest: int = FEWEST_SURVEYS
    floors: bool = False
    windows: bool = False
    sensor: str = STANDARD_SENSOR


def run(config: CalibrateConfig) -> None:
    """Moves thresholds to where simulated surveys put them and writes them with their reasons.

    Example: python -m benchmarks.fidelity calibrate --runs out/a out/b out/c

    Raises:
        FidelityError: Fewer surveys than asked, or a folder without their results.
    """
    if config.windows:
        set_limits(config.runs, LIMITS if config.out == table.THRESHOLDS else config.out, config.sensor)
        return
    if len(config.runs) < config.fewest:
        raise FidelityError(f"calibration needs {config.fewest} simulated surveys, {len(config.runs)} were given")
    surveys = [load_survey(folder) for folder in config.runs]
    if config.floors:
        content = read_json(config.out, THRESHOLDS_SCHEMA)
    else:
        content = {"schema": THRESHOLDS_SCHEMA, "surveys": [s.name for s in surveys], "maps": _calibrated_maps(surveys)}
    rows = table.load(content | {"floors": {}})
    floors = {id: floor for id, row in rows.items() if (floor := noise_floor(row, surveys)) is not None}
    content |= {"floors": floors, "floor_surveys": [survey.name for survey in surveys]}
    write_json(config.out, content)
    print(f"{config.out}: {len(content['maps'])} of {table.COUNT} thresholds moved, {len(floors)} noise floors")


def _calibrated_maps(surveys: list[Survey]) -> dict[str, dict[str, str]]:
    drafted = draft_table()
    return {
        id: {
            "map": table.map_text(row.map),
            "role": row.role,
            "was": f"{drafted[id].role} {table.map_text(drafted[id].map)}",
            "reason": why,
        }
        for id, (row, why) in calibrate(drafted, decided_rows(drafted), surveys).items()
    }


def calibrate(
    rows: dict[str, Metric], decided: dict[str, tuple[Metric, str]], surveys: list[Survey]
) -> dict[str, tuple[Metric, str]]:
    """Return rows with moved maps or roles and the reasons, by metric; unchanged rows are left out.

    Args:
        rows: Rows of the draft.
        decided: Rows changed by hand; rules do not touch them again.
        surveys: Surveys to learn from.
    """
    moved = {id: row for id, (row, _) in decided.items()}
    reasons = {id: [reason] for id, (_, reason) in decided.items()}

    def move(id: str, good: float, bad: float, reason: str) -> None:
        row = current[id]
        moved[id] = current[id] = replace(row, map=move_ends(row.map, good, bad))
        reasons.setdefault(id, []).append(reason)

    current = rows | moved
    for id, row in rows.items():
        if id in decided:
            continue
        if (tight := null_rule(row, surveys)) is not None:
            move(id, *tight)
        elif (upper := good_end_rule(row, surveys)) is not None:
            move(id, upper[0], max(map_ends(row.map)[1], 2.0 * upper[0]), f"good end: {upper[1]}")
    for id, (bad, reason) in bad_end_rule(current, surveys).items():
        if id not in decided:
            move(id, map_ends(current[id].map)[0], bad, f"bad end: {reason}")
    return {id: (row, "; ".join(reasons[id])) for id, row in moved.items()}
