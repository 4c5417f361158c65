"""CSV files, JUnit XML, HTML and Markdown of a report."""

import base64
import csv
import io
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from jinja2 import Environment, FileSystemLoader, select_autoescape

from benchmarks.fidelity import table
from benchmarks.fidelity.files import write_text

METRIC_COLUMNS = ("id", "category", "value", "unit", "score", "role", "evidence", "status", "ci_low", "ci_high", "n",
                  "null_value", "ceiling_value", "skill", "map", "reason")  # fmt: skip


def write_metrics(folder: Path, report: dict[str, Any]) -> Path:
    """`metrics.csv`: a row a metric, always 199."""
    rows = []
    for entry in report["metrics"]:
        low, high = entry["ci95"] or (None, None)
        rows.append({**entry, "ci_low": low, "ci_high": high})
    assert len(rows) == table.COUNT
    return write_csv(folder / "metrics.csv", METRIC_COLUMNS, rows)


def write_categories(folder: Path, report: dict[str, Any]) -> Path:
    """`categories.csv`: a row a category."""
    rows = [{"category": id, **entry} for id, entry in report["categories"].items()]
    return write_csv(folder / "categories.csv", ("category", "name", "score", "null", "ceiling"), rows)


def write_controls(folder: Path, rows: list[dict[str, Any]]) -> Path:
    """`controls.csv`: a row a control and dose."""
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
               "short", "moved", "evaluated", "why", *(f"fall_{c}" for c in table.categories()))  # fmt: skip
    return write_csv(folder / "controls.csv", columns, flat)


def write_sweep(folder: Path, rows: list[dict[str, Any]]) -> Path:
    """`sweep.csv`: a row a run."""
    columns = (
        "kind",
        "run",
        "global",
        "delta",
        "category",
        "category_delta",
        "meets",
        "order_kept",
        "tau",
        "saturated",
    )
    return write_csv(folder / "sweep.csv", columns, rows)


def write_csv(path: Path, columns: tuple[str, ...], rows: list[dict[str, Any]]) -> Path:
    """A CSV file; numbers with 6 significant digits, nothing for what is missing."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({column: _csv_cell(row.get(column)) for column in columns})
    return write_text(path, text.getvalue())


def write_junit(folder: Path, report: dict[str, Any]) -> Path:
    """`junit.xml`: a test a gate and one a category, so that a CI shows which failed."""
    suite = ElementTree.Element("testsuite", name="fidelity")
    failures = 0
    cases = [
        (f"gate.{e['id']}", e["status"] in ("gate failed", "failed"), e["status"] == "missing", e)
        for e in report["metrics"]
        if e["role"] == "G"
    ]
    cases += [
        (f"category.{c}", e["score"] is not None and e["score"] < 70.0, e["score"] is None, e)
        for c, e in report["categories"].items()
    ]
    cases.append(("verdict", report["verdict"] != "PASS", False, {"value": "; ".join(report["reasons"])}))
    for name, failed, skipped, entry in cases:
        case = ElementTree.SubElement(suite, "testcase", classname="fidelity", name=name)
        text = str(entry.get("value", entry.get("score")))
        if failed:
            failures += 1
            ElementTree.SubElement(case, "failure", message=text)
        elif skipped:
            ElementTree.SubElement(case, "skipped", message=str(entry.get("reason", "no reference")))
    suite.set("tests", str(len(cases)))
    suite.set("failures", str(failures))
    ElementTree.indent(suite)
    return write_text(folder / "junit.xml", ElementTree.tostring(suite, encoding="unicode") + "\n")


def _csv_cell(value: Any) -> Any:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else value


def _join_pairs(entries: dict[str, str]) -> str:
    return "; ".join(f"{name} {text}" for name, text in entries.items())


HERE = Path(__file__).parent


def write_html(
    folder: Path, report: dict[str, Any], figures: dict[str, tuple[Path, str]], controls: list[dict[str, Any]]
) -> Path:
    """One file with everything in it.

    Args:
        folder: To write to.
        report: See `content.content`.
        figures: PNG file and caption by name, in order.
        controls: Rows of controls; may be empty.
    """
    pictures = [
        {"name": name, "caption": caption, "data": base64.b64encode(path.read_bytes()).decode()}
        for name, (path, caption) in figures.items()
    ]
    return write_text(folder / "report.html", _render("report.html.j2", report, figures=pictures, controls=controls))


def write_markdown(folder: Path, report: dict[str, Any]) -> Path:
    """The short form, for logs."""
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
    """A value for people; a dash for what is missing."""
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return str(value)
