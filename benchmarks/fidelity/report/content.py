"""The report as plain data, before it takes any form."""

import platform
import subprocess
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fidelity import scoring, store, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls import runner, verdicts
from benchmarks.fidelity.inputs import Inputs
from benchmarks.fidelity.judge import Judgement
from benchmarks.fidelity.report import paper
from benchmarks.fidelity.table import Metric

SCHEMA = "subterra.fidelity/1"
VERSIONS = ("mujoco", "mujoco-mjx", "jax", "numpy", "scipy", "trimesh", "embreex", "shapely", "scikit-image",
            "scikit-learn", "manifold3d", "gudhi", "small-gicp",
            "pymeshlab", "py4dgeo", "connected-components-3d")  # fmt: skip


def content(
    case: Case,
    inputs: Inputs,
    judgement: Judgement,
    controls: list[dict[str, Any]] | None = None,
    sweep: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Everything that `report.json` holds.

    Args:
        case: What was judged and against what.
        inputs: As the command resolved them.
        judgement: Of the case.
        controls: Rows of `verdicts.rows` where controls were run.
        sweep: Summary of the sweep where it was run.
    """
    scored, null = judgement.scored["base"], judgement.scored["null"]
    worst = min((v, c) for c, v in scored.categories.items() if v is not None) if scored.evaluated else (None, None)
    rows = controls or []
    return {
        "schema": SCHEMA,
        "title": title(case),
        "name": case.candidate.name,
        "verdict": judgement.verdict,
        "reasons": judgement.reasons,
        "global": scored.overall,
        "categories_evaluated": scored.evaluated,
        "global_evidence": scored.evidence,
        "global_null": null.overall,
        "lead_over_null": None if scored.overall is None or null.overall is None else scored.overall - null.overall,
        "median_skill": judgement.skill,
        "worst_category": {"category": worst[1], "score": worst[0]},
        "failed_gates": list(scored.failed_gates),
        "saturated_frac": scored.saturated,
        "strict": inputs.strict,
        "leaks": judgement.leaks,
        "split": _split(case, inputs),
        "seed": inputs.seed,
        "thresholds_hash": table.thresholds_hash(),
        "code_hash": store.code_hash(),
        "commit": _commit(),
        "versions": _versions(),
        "config": asdict(inputs.hold),
        "paper": paper.rows(judgement),
        "categories": {
            name: {"name": words, "score": scored.categories[name], "null": null.categories[name],
                   "ceiling": _ceiling(judgement, name)}
            for name, words in table.categories().items()
        },
        "metrics": [_metric(row, judgement) for row in table.load().values()],
        "controls": {
            "run": len(rows),
            "complete": _all_bold(rows),
            "undetected": verdicts.undetected(rows),
            "loud": verdicts.loud(rows),
        } if controls is not None else None,
        "sweep": sweep,
    }  # fmt: skip


def title(case: Case) -> str:
    """`Fidelity` where something was held out or is known, else what it is."""
    return "Fidelity" if case.hold is not None or case.truth is not None else "Self-consistency"


def _all_bold(rows: list[dict[str, Any]]) -> bool:
    """Whether every control was run at every dose that must fail."""
    asked = {(job.control, job.dose) for job in runner.jobs() if runner.is_bold(job)}
    return asked <= {(row["id"], row["dose"]) for row in rows}


def _metric(row: Metric, judgement: Judgement) -> dict[str, Any]:
    score = judgement.scored["base"].scores[row.id]
    value = score.value
    null, ceiling = (
        judgement.values[name][row.id].value if name in judgement.values else None for name in ("null", "ceiling")
    )
    return {
        "id": row.id, "category": row.category, "definition": row.definition, "value": value.value, "unit": row.unit,
        "ci95": value.interval, "n": value.n, "score": score.score, "role": row.role, "evidence": row.evidence,
        "map": map_text(row), "null_value": null, "ceiling_value": ceiling,
        "skill": scoring.skill(value.value, null, ceiling), "status": _status(row, score), "reason": value.reason,
    }  # fmt: skip


def map_text(row: Metric) -> str:
    """The map as the table writes it."""
    good, bad, target = (np.format_float_positional(v, trim="-") for v in (row.map.good, row.map.bad, row.map.target))
    texts = {"D": f"D({good},{bad})", "U": f"U({bad},{good})", "B": f"B({target};{good},{bad})"}
    return texts.get(row.map.kind, row.map.kind)


def _status(row: Metric, score: scoring.Score) -> str:
    if score.value.failed:
        return "failed"
    if score.value.value is None:
        return "missing"
    if "C" in row.evidence:
        return "by construction"
    if row.role == "G" and (score.score or 0.0) < scoring.GATE_FLOOR:
        return "gate failed"
    return "scored" if row.scored else "logged"


def _ceiling(judgement: Judgement, name: str) -> float | None:
    return judgement.scored["ceiling"].categories[name] if "ceiling" in judgement.scored else None


def _split(case: Case, inputs: Inputs) -> dict[str, Any]:
    hold = case.hold
    given = case.candidate.manifest.get("inputs", [])
    return {
        "builder": [{"file": entry.get("file"), "sha256": entry.get("sha256")} for entry in given],
        "hold": None if hold is None else {
            "file": inputs.recording.name if inputs.recording else "", "sha256": hold.hash, "sensor": hold.sensor,
            "sigma": hold.sigma, "beams": len(hold.range), "scans": len(set(hold.scan.tolist())),
        },
        "truth": None if case.truth is None else "generator",
        "rule": "cross-sensor" if hold is not None and case.fit is not None else "as given",
    }  # fmt: skip


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in VERSIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _commit() -> str | None:
    here = Path(__file__).parent
    done = subprocess.run(["git", "-C", str(here), "rev-parse", "HEAD"], capture_output=True, text=True)
    return done.stdout.strip() or None
