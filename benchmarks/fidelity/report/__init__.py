"""The report as plain data, and its forms: JSON, CSV, HTML, figures."""

import base64
import platform
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader

from benchmarks.fidelity import judge, outside, scoring, table
from benchmarks.fidelity.case import Case, code_hash
from benchmarks.fidelity.faults.kinds import suite_controls
from benchmarks.fidelity.files import write_csv, write_json, write_text
from benchmarks.fidelity.inputs import Inputs
from benchmarks.fidelity.judge import Judgement
from benchmarks.fidelity.report.figures import Sheet, draw_all
from benchmarks.fidelity.scoring import Score, Scored
from benchmarks.fidelity.table import Metric
from benchmarks.fidelity.windows.judge import dump_windows
from benchmarks.results import commit, version


def paper_rows(judgement: Judgement) -> list[dict[str, Any]]:
    """Return a row per number of the paper: its name, the paper's figure, ours, unit, evidence class and a note."""
    scored, null = judgement.scored["base"], judgement.scored["null"].overall

    def ours(id: str, name: str = "base") -> float | None:
        value = judgement.values[name][id].value
        return None if value is None else 100.0 * value

    counts = f"{len(scored.categories)} / {len(judgement.values['base'])}"
    over = f"over {scored.evaluated} of {len(scored.categories)} categories; the null tube has {number_text(null)}"
    rows = (
        ("global score", 97.1, scored.overall, "%", "mixed", over),
        ("categories / metrics", "18 / 199", counts, "", "-", "same counts"),
        ("cloud to mesh, mean, cloud cast in the same mesh", 2.46, ours("selfcast_p2s_mean"), "cm", "C",
         "by construction: range noise alone, alike for any mesh; logged, never scored"),
        ("the same within 10 cm", 97.5, ours("selfcast_within_10cm"), "%", "C", "by construction, as above"),
        ("cloud to mesh, mean, held-out points", 2.46, ours("c2m_mean"), "cm", "H",
         "the comparable claim, on points that the builder never read"),
        ("the same within 10 cm", 97.5, ours("c2m_within_10cm"), "%", "H", "held-out points"),
        ("the same, null tube", None, ours("c2m_mean", "null"), "cm", "H",
         "what a constant tube on the right axis gets"),
    )  # fmt: skip
    return [dict(zip(("what", "paper", "here", "unit", "evidence", "note"), row, strict=True)) for row in rows]


SCHEMA = "subterra.fidelity/1"
_CANDIDATES = {"score": "base", "null": "null", "ceiling": "ceiling"}  # columns of a report
VERSIONS = ("mujoco", "mujoco-mjx", "jax", "numpy", "scipy", "trimesh", "embreex", "shapely", "scikit-image",
            "scikit-learn", "manifold3d", "gudhi", "small-gicp",
            "pymeshlab", "py4dgeo", "connected-components-3d")  # fmt: skip


def report_content(
    case: Case, inputs: Inputs, judgement: Judgement, controls: list[dict[str, Any]] | None = None
) -> dict[str, Any]:
    scored, null = judgement.scored["base"], judgement.scored["null"]
    worst = min((v, c) for c, v in scored.categories.items() if v is not None) if scored.evaluated else (None, None)
    rows = controls or []
    return {
        "schema": SCHEMA,
        "title": "Fidelity" if case.has("reference") else "Self-consistency",
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
        "leaks": judgement.leaks,
        "windows": dump_windows(judgement.windows),
        "split": _split_entry(case, inputs),
        "seed": inputs.seed,
        "constants": judge.constants_digest(),
        "code_hash": code_hash(),
        "commit": commit(),
        "versions": {"python": platform.python_version()} | {one: version(one) or "not installed" for one in VERSIONS},
        "config": asdict(inputs.hold),
        "paper": paper_rows(judgement),
        "categories": _category_entries(judgement.scored),
        "metrics": [_metric_entry(row, judgement.scored) for row in table.load().values()],
        "outside": _outside_entry(judgement),
        "controls": {
            "run": len(rows),
            "complete": {(control.id, dose) for control in suite_controls().values() for dose in control.bold}
            <= {(row["id"], row["dose"]) for row in rows},
            "undetected": judge.undetected(rows),
            "loud": judge.loud(rows),
        } if controls is not None else None,
    }  # fmt: skip


def _category_entries(scored: dict[str, Scored]) -> dict[str, dict[str, Any]]:
    by = {key: scored[name].categories if name in scored else {} for key, name in _CANDIDATES.items()}
    return {
        name: {"name": words} | {key: scores.get(name) for key, scores in by.items()}
        for name, words in table.CATEGORIES.items()
    }


def _metric_entry(row: Metric, scored: dict[str, Scored]) -> dict[str, Any]:
    """Return value, score, status and the values of null tube and truth of a metric."""
    score = scored["base"].scores[row.id]
    value = score.value
    null, ceiling = (
        scored[name].scores[row.id].value.value if name in scored else None for name in ("null", "ceiling")
    )
    return {
        "id": row.id, "category": row.category, "definition": row.definition, "value": value.value, "unit": row.unit,
        "ci95": value.interval, "n": value.n, "score": score.score, "role": row.role, "evidence": row.evidence,
        "map": str(row.map), "null_value": null, "ceiling_value": ceiling,
        "skill": scoring.skill(value.value, null, ceiling), "status": _status(row, score), "reason": value.reason,
    }  # fmt: skip


def _outside_entry(judgement: Judgement) -> dict[str, Any] | None:
    """Return the metrics from outside, and categories and global figure with them; `None` without such metrics."""
    if not judgement.outside:
        return None
    metrics, source = outside.metrics(), next(iter(outside.files()), "Python")
    entries = [_metric_entry(row, judgement.outside) | {"source": source} for row in metrics.values()]
    return {
        "files": outside.files(),
        "count": len(metrics),
        "count_with_suite": len(table.load()) + len(metrics),
        "metrics": entries,
        "categories": {
            name: entry
            for name, entry in _category_entries(judgement.outside).items()
            if name in {row.category for row in metrics.values()}
        },
        "global": judgement.outside["base"].overall,
        "note": "The verdict and all other figures are those of the suite's 199 metrics alone.",
    }


def _status(row: Metric, score: Score) -> str:
    if score.value.failed:
        return "failed"
    if score.value.value is None:
        return "missing"
    if "C" in row.evidence:
        return "by construction"
    if row.role == "G" and (score.score or 0.0) < scoring.GATE_FLOOR:
        return "gate failed"
    return "scored" if row.scored else "logged"


def _split_entry(case: Case, inputs: Inputs) -> dict[str, Any]:
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


def write_report(
    folder: Path, case: Case, inputs: Inputs, judgement: Judgement, controls: list[dict[str, Any]] | None
) -> dict[str, Any]:
    content = report_content(case, inputs, judgement, controls)
    rows = controls or []
    write_json(folder / "report.json", content)
    write_metrics(folder, content)
    write_controls(folder, rows)
    figures = draw_all(folder / "figures", Sheet(case, content))
    write_html(folder, content, figures, rows)
    return content


# The forms: CSV files and HTML.

METRIC_COLUMNS = ("id", "category", "value", "unit", "score", "role", "evidence", "status", "ci_low", "ci_high", "n",
                  "null_value", "ceiling_value", "skill", "map", "reason")  # fmt: skip


def write_metrics(folder: Path, report: dict[str, Any]) -> Path:
    """Writes `metrics.csv`: a row per metric of the suite.

    Metrics from outside follow; the column `source`, which is there only then, names the suite or the file.
    """
    more = [] if report["outside"] is None else report["outside"]["metrics"]
    rows = []
    for entry in report["metrics"] + more:
        low, high = entry["ci95"] or (None, None)
        rows.append({"source": "suite", **entry, "ci_low": low, "ci_high": high})
    columns = METRIC_COLUMNS + (("source",) if more else ())
    return write_csv(folder / "metrics.csv", columns, rows)


def write_controls(folder: Path, rows: list[dict[str, Any]]) -> Path:
    flat = [
        {
            **row,
            "quiet": "yes" if row["quiet"] else "no",
            "detected": "" if row["kind"] == "invariance" else "yes" if row["detected"] else "no",
            "short": _join_pairs({c: f"{(got or 0.0):.1f} of {asked:g}" for c, (got, asked) in row["short"].items()}),
            "moved": _join_pairs({c: f"{fall:+.1f}" for c, fall in row["moved"].items() if fall is not None}),
            "why": "; ".join(row["why"]),
            **{f"fall_{c}": fall for c, fall in row["falls"].items()},
        }
        for row in rows
    ]
    columns = ("id", "kind", "corruption", "dose", "bold", "verdict", "detected", "quiet", "spearman", "overall",
               "short", "moved", "evaluated", "why", *(f"fall_{c}" for c in table.CATEGORIES))  # fmt: skip
    return write_csv(folder / "controls.csv", columns, flat)


def _join_pairs(entries: dict[str, str]) -> str:
    return "; ".join(f"{name} {text}" for name, text in entries.items())


def write_html(
    folder: Path, report: dict[str, Any], figures: dict[str, tuple[Path, str]], controls: list[dict[str, Any]]
) -> Path:
    pictures = [
        {"name": name, "caption": caption, "data": base64.b64encode(path.read_bytes()).decode()}
        for name, (path, caption) in figures.items()
    ]
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["figure"] = number_text
    text = environment.get_template("report.html.j2").render(report=report, figures=pictures, controls=controls)
    return write_text(folder / "report.html", text)


def number_text(value: Any, digits: int = 4) -> str:
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return str(value)
