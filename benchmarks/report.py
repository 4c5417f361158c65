"""The demo's report: one self-contained HTML page with figures, tables and no file or address outside itself."""

import base64
import html
import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.draw.scene import picture
from benchmarks.results import png_bytes
from benchmarks.truth import Truth, centreline
from subterra_jax.pictures.renderer import PictureError

_STYLE = """
:root { color-scheme: light dark; --ink: #1d2b36; --line: #d5dbe1; --soft: #f4f6f8; --paper: #ffffff; }
@media (prefers-color-scheme: dark) { :root { --ink: #dfe6ec; --line: #3a4753; --soft: #1c252d; --paper: #131a20; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 68rem;
  margin: 2rem auto; padding: 0 1rem; }
h2 { margin-top: 2.4rem; border-bottom: 1px solid var(--line); padding-bottom: .2rem; }
figure { margin: 1rem 0; }
figure img { width: 100%; background: #fff; border: 1px solid var(--line); border-radius: 6px; }
figcaption, .note { color: color-mix(in srgb, var(--ink) 70%, transparent); font-size: .92rem; }
table { border-collapse: collapse; width: 100%; } th, td { text-align: left; padding: .35rem .6rem; }
th, td { border-bottom: 1px solid var(--line); }
th.number, td.number { text-align: right; font-variant-numeric: tabular-nums; }
tr.missed td { background: color-mix(in srgb, #c1121f 14%, transparent); }
.simulated { display: inline-block; background: var(--soft); border: 1px solid var(--line);
  border-radius: 4px; padding: 0 .5rem; }
"""


def html_page(title: str, parts: Iterable[str]) -> str:
    """Returns a whole HTML page."""
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>'
        f"<body>\n{body}\n</body></html>\n"
    )


def html_text(text: str, tag: str = "p", kind: str = "note") -> str:
    """Returns a paragraph or heading; the text is escaped."""
    return f'<{tag} class="{kind}">{html.escape(text)}</{tag}>'


def html_figure(content: Figure | np.ndarray | bytes, caption: str) -> str:
    """Embeds a figure, which is closed, an `(h, w, 3)` picture, or the bytes of a PNG or WebP file."""
    if isinstance(content, Figure):
        content = png_bytes(content, dpi=130)
    elif isinstance(content, np.ndarray):
        buffer = io.BytesIO()
        Image.fromarray(content).save(buffer, format="png")
        content = buffer.getvalue()
    kind = "webp" if content[8:12] == b"WEBP" else "png"
    data, text = base64.b64encode(content).decode(), html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/{kind};base64,{data}"><figcaption>{text}</figcaption></figure>'


def html_table(columns: tuple[str, ...], rows: Iterable[tuple[tuple[str, ...], bool]]) -> str:
    """Returns a table of strings; a row's flag marks a missed goal. The second column is set as numbers."""

    def line(cells: tuple[str, ...], tag: str) -> str:
        kinds = ("number" if k == 1 else "text" for k in range(len(columns)))
        marked = (f'<{tag} class="{kind}">{html.escape(cell)}</{tag}>' for kind, cell in zip(kinds, cells, strict=True))
        return "".join(marked)

    body = (f'<tr class="{"missed" if missed else "met"}">{line(cells, "td")}</tr>' for cells, missed in rows)
    return f"<table><thead><tr>{line(columns, 'th')}</tr></thead><tbody>{''.join(body)}</tbody></table>"


_INK, _TRUTH = "#1b4965", "#c1121f"


def plan_and_profile(truth: Truth, built: tuple[np.ndarray, np.ndarray]) -> Figure:
    """Draws the true centreline and the built one, stations and positions in m, from above and from the side."""
    figure, (plan, profile) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    start = truth.position[0]
    direction = truth.position[-1, :2] - start[:2]
    direction /= np.linalg.norm(direction)
    turn = np.array([direction, [-direction[1], direction[0]]])

    def draw(station: np.ndarray, position: np.ndarray, **style: object) -> None:
        along, across = turn @ (position[:, :2] - start[:2]).T
        plan.plot(along, across, **style)
        profile.plot(station, position[:, 2] - start[2], **style)

    draw(truth.station, truth.position, color=_TRUTH, lw=4, alpha=0.4, label="truth (simulated)")
    draw(*built, color=_INK, lw=1.4, label="reconstructed")
    plan.set(title="Plan", xlabel="along the chord, m", ylabel="across, m")
    plan.set_aspect("equal", adjustable="datalim")
    profile.set(title="Profile", xlabel="station, m", ylabel="height above the start, m")
    plan.legend(fontsize=8)
    for axes in (plan, profile):
        axes.grid(alpha=0.3)
    return figure


class Row(NamedTuple):
    """A row of the report: key in `summary.json`, text, unit with its factor, decimals, goal and its direction."""

    key: str
    text: str
    unit: str
    factor: float = 1.0
    decimals: int = 2
    goal: float | None = None
    less: bool = True


_ROWS = (
    Row("length", "Length of the true centreline", "m"),
    Row("length_error", "Reconstructed less true length", "cm", 100, 1),
    Row("centreline_rmse", "Centreline RMSE", "cm", 100, goal=5.0),
    Row("width_rmse", "Width RMSE", "cm", 100, goal=4.0),
    Row("height_rmse", "Height RMSE", "cm", 100, goal=4.0),
    Row("coverage_mean_100", "Coverage, mean of the last 100 training episodes", "%", 100, goal=90.0, less=False),
    Row("success_mean_100", "Success in the last 100 training episodes", "%", 100, 1),
    Row("evaluation_coverage", "Coverage in evaluation, noise-free policy", "%", 100),
    Row("evaluation_success", "Success in evaluation", "%", 100, 1),
    Row("evaluation_episodes", "Episodes of the evaluation", "", decimals=0),
    Row("train_steps", "Environment steps of training", "million", 1e-6),
    Row("geoms", "Geoms in the scene", "", decimals=0),
    Row("mesh_faces", "Triangles in the scene", "", decimals=0),
    Row("rover_metres", "Driven by its rover in 4 s", "m"),
    Row("seconds", "The whole demo", "s", decimals=0, goal=120.0),
)


def write_report(out: Path, summary: dict[str, Any], truth: Truth) -> Path:
    """Writes `report.html` and returns its path.

    Args:
        out: Folder of the demo; `film.webp`, `survey`, `scene` and `training` in it are read.
        summary: Figures in SI units.
        truth: Truth of the simulated survey.
    """
    driven = (
        f"The trained policy drives {summary['task']} in the reconstructed bore. Robot: a skid-steer platform, "
        "modelled kinematically. Sensor: 16 planar ranges and a drifting odometer. Reward: the paper's, for the part "
        "of the tunnel newly covered, less offset from the middle and changes of command."
    )
    learnt = "Coverage of each training episode and their mean of 100."
    seconds = [((name, f"{value:.1f}"), False) for name, value in summary["stage_seconds"].items()]
    parts = [
        html_text("Subterra: from a recording to a trained agent", "h1"),
        html_text("simulated survey: nothing here was measured in a real tunnel", kind="simulated"),
        html_figure((out / "film.webp").read_bytes(), driven),
        html_text("Figures", "h2"),
        html_table(("Figure", "Value", "Unit", "Goal"), _figure_rows(summary)),
        html_text(_verdict(out / "scene")),
        html_text("The bore", "h2"),
        *_bore_parts(out, truth),
        html_text("What was learnt in it", "h2"),
        html_figure((out / "training" / "curve.png").read_bytes(), learnt),
        html_text("Where the time went", "h2"),
        html_table(("Stage", "Seconds"), seconds),
    ]
    path = out / "report.html"
    path.write_text(html_page("Subterra demo", parts))
    return path


def _bore_parts(out: Path, truth: Truth) -> list[str]:
    scene = out / "scene"
    try:
        view = html_figure(picture(scene, "scout"), "The scene in MuJoCo, from the camera of its scout robot.")
    except PictureError as error:
        view = html_text(f"No picture of the scene: {error}")
    line = "Plan and profile of the centreline; nothing is aligned. Sections stand in scene/build.html."
    return [
        view,
        html_figure(plan_and_profile(truth, centreline(scene)), line),
    ]


def _verdict(scene: Path) -> str:
    """Returns what the builder's own judge says of the scene; the fidelity suite is a command of its own."""
    judged = json.loads((scene / "manifest.json").read_text())["judgement"]
    warned = "; ".join(map(str, judged["warnings"])) or "none"
    explained, returns = 100 * judged["share"]["explained"], judged["returns"] / 1e6
    return (
        f"The builder's judge: {explained:.2f} % of {returns:.1f} million returns lie within "
        f"{100 * judged['tolerance']:g} cm of the scene, {100 * judged['wall_seen']:.1f} % of the wall was seen; "
        f"warnings: {warned}. The 199 metrics and their verdict: python -m benchmarks.fidelity run."
    )


def _figure_rows(summary: dict[str, Any]) -> list[tuple[tuple[str, ...], bool]]:
    rows: list[tuple[tuple[str, ...], bool]] = []
    for row in _ROWS:
        value = summary.get(row.key)
        goal = "" if row.goal is None else f"{'≤' if row.less else '≥'} {row.goal:g}"
        if value is None or not np.isfinite(value):
            rows.append(((row.text, "-", row.unit, goal), row.goal is not None))
            continue
        shown = row.factor * value
        missed = row.goal is not None and (shown > row.goal if row.less else shown < row.goal)
        rows.append(((row.text, f"{shown:,.{row.decimals}f}", row.unit, goal), missed))
    return rows
