"""CSV files, JUnit XML, HTML and Markdown of a report."""

import base64
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from jinja2 import Environment, FileSystemLoader, select_autoescape

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.files import write_csv, write_text

HERE = Path(__file__).parent
METRIC_COLUMNS = ("id", "category", "value", "unit", "score", "role", "evidence", "status", "ci_low", "ci_high", "n",
                  "null_value", "ceiling_value", "skill", "map",
                  "worst_start", "worst_value", "worst_score", "reason")  # fmt: skip


def write_metrics(folder: Path, report: dict[str, Any]) -> Path:
    """Writes `metrics.csv`: a row per metric of the suite.

    Metrics from outside follow; the column `source`, which is there only then, names the suite or the file.
    """
    more = [] if report["outside"] is None else report["outside"]["metrics"]
    rows = []
    for entry in report["metrics"] + more:
        low, high = entry["ci95"] or (None, None)
        worst = {f"worst_{key}": value for key, value in (entry["worst_stretch"] or {}).items()}
        rows.append({"source": "suite", **entry, "ci_low": low, "ci_high": high, **worst})
    columns = METRIC_COLUMNS + (("source",) if more else ())
    return write_csv(folder / "metrics.csv", columns, rows)


def write_categories(folder: Path, report: dict[str, Any]) -> Path:
    """Writes `categories.csv`: a row per category, with a column for the score with metrics from outside, if any."""
    columns: tuple[str, ...] = ("category", "name", "score", "null", "ceiling")
    rows = [{"category": id, **entry} for id, entry in report["categories"].items()]
    if report["outside"] is not None:
        columns += ("score_with_outside",)
        for row in rows:
            row["score_with_outside"] = report["outside"]["categories"].get(row["category"], row)["score"]
    return write_csv(folder / "categories.csv", columns, rows)


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


def write_sweep(folder: Path, rows: list[dict[str, Any]]) -> Path:
    columns = ("kind", "run", "global", "delta", "category", "category_delta", "meets", "order_kept", "tau",
               "saturated")  # fmt: skip
    return write_csv(folder / "sweep.csv", columns, rows)


def _join_pairs(entries: dict[str, str]) -> str:
    return "; ".join(f"{name} {text}" for name, text in entries.items())


def write_junit(folder: Path, report: dict[str, Any]) -> Path:
    """Writes `junit.xml`: a test per gate and category and one for the verdict, so that a CI shows the failed ones.

    Scored metrics from outside are tests of the class `fidelity.outside`; below half marks they fail.
    """
    suite = ElementTree.Element("testsuite", name="fidelity")
    cases = [
        ("fidelity", f"gate.{e['id']}", e["status"] in ("gate failed", "failed"), e["status"] == "missing", e)
        for e in report["metrics"]
        if e["role"] == "G"
    ]
    cases += [
        ("fidelity", f"category.{c}", e["score"] is not None and e["score"] < scoring.PASS_CATEGORY,
         e["score"] is None, e)
        for c, e in report["categories"].items()
    ]  # fmt: skip
    verdict = {"value": "; ".join(report["reasons"])}
    cases.append(("fidelity", "verdict", report["verdict"] != "PASS", False, verdict))
    cases += [
        ("fidelity.outside", f"metric.{e['id']}", e["score"] is not None and e["score"] < scoring.GATE_FLOOR,
         e["status"] == "missing", e)
        for e in (report["outside"] or {"metrics": []})["metrics"]
        if e["role"] != "L"
    ]  # fmt: skip
    for name, test, failed, skipped, entry in cases:
        case = ElementTree.SubElement(suite, "testcase", classname=name, name=test)
        if failed:
            ElementTree.SubElement(case, "failure", message=str(entry.get("value", entry.get("score"))))
        elif skipped:
            ElementTree.SubElement(case, "skipped", message=str(entry.get("reason", "no reference")))
    suite.set("tests", str(len(cases)))
    suite.set("failures", str(sum(failed for _, _, failed, _, _ in cases)))
    ElementTree.indent(suite)
    return write_text(folder / "junit.xml", ElementTree.tostring(suite, encoding="unicode") + "\n")


def write_html(
    folder: Path, report: dict[str, Any], figures: dict[str, tuple[Path, str]], controls: list[dict[str, Any]]
) -> Path:
    """Writes `report.html`, one file with everything in it.

    Args:
        folder: Folder to write to.
        report: Content of the report.
        figures: PNG file and caption by name, in order.
        controls: Rows of controls; may be empty.
    """
    pictures = [
        {"name": name, "caption": caption, "data": base64.b64encode(path.read_bytes()).decode()}
        for name, (path, caption) in figures.items()
    ]
    text = _render("report.html.j2", report, figures=pictures, controls=controls)
    return write_text(folder / "report.html", text)


def write_markdown(folder: Path, report: dict[str, Any]) -> Path:
    return write_text(folder / "report.md", _render("report.md.j2", report, figures=[], controls=[]))


def _render(template: str, report: dict[str, Any], **more: Any) -> str:
    environment = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=select_autoescape(["html.j2", "html"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["figure"] = number_text
    return environment.get_template(template).render(report=report, **more)


def number_text(value: Any, digits: int = 4) -> str:
    """Return a value for people; a dash for a missing one."""
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return str(value)
