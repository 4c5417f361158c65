"""Puts thresholds where simulated surveys with known truth say they belong, before any real data is scored."""

from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.fidelity import evidence, rules, store, table
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.evidence import Survey
from benchmarks.fidelity.report.content import map_text
from benchmarks.fidelity.table import Metric

SCHEMA = "subterra.fidelity-thresholds/1"
FEWEST = 3


@dataclass(frozen=True)
class CalibrateConfig:
    """Where the evidence lies.

    Attributes:
        runs: Output folders of `controls` on simulated surveys with `--truth`.
        out: File to write; the table takes its thresholds from there.
        fewest: Surveys that are enough.
    """

    runs: tuple[Path, ...]
    out: Path = table.THRESHOLDS
    fewest: int = FEWEST


def run(config: CalibrateConfig) -> None:
    """Moves thresholds to where simulated surveys put them and writes them with their reasons.

    Example: python -m benchmarks.fidelity calibrate --runs out/a out/b out/c

    Raises:
        FidelityError: Fewer surveys than asked, or a folder without their results.
    """
    if len(config.runs) < config.fewest:
        raise FidelityError(f"calibration needs {config.fewest} simulated surveys, {len(config.runs)} were given")
    surveys = [evidence.load(folder) for folder in config.runs]
    drafted = evidence.draft()
    maps = {
        id: {
            "map": map_text(row),
            "role": row.role,
            "was": f"{drafted[id].role} {map_text(drafted[id])}",
            "reason": why,
        }
        for id, (row, why) in calibrated(drafted, evidence.decided(drafted), surveys).items()
    }
    store.write_json(config.out, {"schema": SCHEMA, "surveys": [survey.name for survey in surveys], "maps": maps})
    print(f"{config.out}: {len(maps)} of {table.COUNT} thresholds moved")


def calibrated(
    rows: dict[str, Metric], decided: dict[str, tuple[Metric, str]], surveys: list[Survey]
) -> dict[str, tuple[Metric, str]]:
    """Rows with moved maps or roles and the reasons, by metric; what evidence says nothing against is not among them.

    Args:
        rows: The draft.
        decided: Rows changed by hand; rules do not touch them again.
        surveys: The evidence.
    """
    moved = {id: row for id, (row, _) in decided.items()}
    reasons = {id: [reason] for id, (_, reason) in decided.items()}

    def move(id: str, good: float, bad: float, reason: str) -> None:
        row = current[id]
        moved[id] = current[id] = replace(row, map=evidence.moved(row.map, good, bad))
        reasons.setdefault(id, []).append(reason)

    current = rows | moved
    for id, row in rows.items():
        if id in decided:
            continue
        if (tight := rules.null_ends(row, surveys)) is not None:
            move(id, *tight)
        elif (upper := rules.good_end(row, surveys)) is not None:
            move(id, upper[0], max(evidence.ends(row.map)[1], 2.0 * upper[0]), f"good end: {upper[1]}")
    for id, (bad, reason) in rules.bad_ends(current, surveys).items():
        if id not in decided:
            move(id, evidence.ends(current[id].map)[0], bad, f"bad end: {reason}")
    return {id: (row, "; ".join(reasons[id])) for id, row in moved.items()}
