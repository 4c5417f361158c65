"""What a judgement is written as: JSON, CSV, HTML, Markdown, JUnit, figures."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.fidelity import store
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.figures import Sheet, draw_all
from benchmarks.fidelity.inputs import Inputs
from benchmarks.fidelity.judge import Judgement
from benchmarks.fidelity.null import null_tube
from benchmarks.fidelity.report import page, tables
from benchmarks.fidelity.report.content import content


def write(
    folder: Path,
    case: Case,
    inputs: Inputs,
    judgement: Judgement,
    controls: list[dict[str, Any]] | None,
    swept: dict[str, Any] | None,
) -> dict[str, Any]:
    """Writes every form of the report and returns its content.

    Args:
        folder: To write to.
        case: What was judged.
        inputs: As resolved.
        judgement: Of the case.
        controls: Rows of controls where they were run.
        swept: What `sweep.json` holds where the sweep was run.
    """
    made = content(case, inputs, judgement, controls, swept["summary"] if swept else None)
    rows = controls or []
    store.write_json(folder / "report.json", made)
    tables.write_metrics(folder, made)
    tables.write_categories(folder, made)
    tables.write_controls(folder, rows)
    tables.write_sweep(folder, swept["rows"] if swept else [])
    tables.write_junit(folder, made)
    null = replace(case, candidate=null_tube(case.candidate), cache={})
    figures = draw_all(folder / "figures", Sheet(case, null, made, rows, swept["rows"] if swept else []))
    page.write_markdown(folder, made)
    page.write_html(folder, made, figures, rows)
    return made
