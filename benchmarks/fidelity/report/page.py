"""`report.html` and `report.md` from one report and its figures."""

import base64
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, select_autoescape

from benchmarks.fidelity import store

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
    return store.write_text(
        folder / "report.html", _render("report.html.j2", report, figures=pictures, controls=controls)
    )


def write_markdown(folder: Path, report: dict[str, Any]) -> Path:
    """The short form, for logs."""
    return store.write_text(folder / "report.md", _render("report.md.j2", report, figures=[], controls=[]))


def _render(template: str, report: dict[str, Any], **more: Any) -> str:
    environment = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=select_autoescape(["html.j2", "html"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["figure"] = number
    return environment.get_template(template).render(report=report, **more)


def number(value: Any, digits: int = 4) -> str:
    """A value for people; a dash for what is missing."""
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return str(value)
