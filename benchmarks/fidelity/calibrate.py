"""Puts thresholds where simulated surveys with known truth say they belong, before any real data is scored."""

from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.fidelity import evidence, store, table
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.evidence import Survey
from benchmarks.fidelity.report.content import map_text
from benchmarks.fidelity.table import Map, Metric

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

    Raises:
        FidelityError: Fewer surveys than asked, or a folder without their results.
    """
    if len(config.runs) < config.fewest:
        raise FidelityError(f"calibration needs {config.fewest} simulated surveys, {len(config.runs)} were given")
    surveys = [evidence.load(folder) for folder in config.runs]
    drafted = evidence.draft()
    maps = {
        id: {"map": map_text(replace(drafted[id], map=map)), "was": map_text(drafted[id]), "reason": reason}
        for id, (map, reason) in calibrated(drafted, surveys).items()
    }
    store.write_json(config.out, {"schema": SCHEMA, "surveys": [survey.name for survey in surveys], "maps": maps})
    print(f"{config.out}: {len(maps)} of {table.COUNT} thresholds moved")


def calibrated(rows: dict[str, Metric], surveys: list[Survey]) -> dict[str, tuple[Map, str]]:
    """Moved maps with their reasons, by metric; what evidence says nothing against is not among them."""
    lower = evidence.bad_ends(rows, surveys)
    found = {}
    for id, row in rows.items():
        if not row.scored or row.map.kind not in "DUB":
            continue
        good, bad = evidence.ends(row.map)
        reasons = []
        if (upper := evidence.good_end(row, surveys)) is not None:
            good, bad = upper[0], max(bad, 2.0 * upper[0])
            reasons.append(f"good end: {upper[1]}")
        if id in lower and lower[id][0] > evidence.WIDEN * good:
            bad = lower[id][0]
            reasons.append(f"bad end: {lower[id][1]}")
        if reasons:
            found[id] = (evidence.moved(row.map, good, bad), "; ".join(reasons))
    return found
