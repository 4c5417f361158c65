"""The demo's report: one self-contained HTML page with figures, tables and no file or address outside itself."""

import base64
import html
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.draw import scene as drawing
from benchmarks.truth import Comparison, Truth, centreline, compare, start_placement

_STYLE = """
:root { color-scheme: light dark; --ink: #1d2b36; --line: #d5dbe1; --soft: #f4f6f8; --paper: #ffffff; }
@media (prefers-color-scheme: dark) { :root { --ink: #dfe6ec; --line: #3a4753; --soft: #1c252d; --paper: #131a20; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 68rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: .2rem; }
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


def html_heading(text: str, level: int = 2) -> str:
    """Returns a heading; the text is escaped."""
    return f"<h{level}>{html.escape(text)}</h{level}>"


def html_paragraph(text: str, kind: str = "note") -> str:
    """Returns a paragraph; the text is escaped."""
    return f'<p class="{kind}">{html.escape(text)}</p>'


def html_figure(content: Figure | np.ndarray | bytes, caption: str) -> str:
    """Embeds a figure, an `(h, w, 3)` picture or PNG bytes."""
    data = base64.b64encode(_png(content)).decode()
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def html_table(columns: tuple[str, ...], rows: Iterable[tuple[tuple[str, ...], bool]]) -> str:
    """Returns a table of strings; a row's flag marks a missed goal. The second column is set as numbers."""
    kinds = ["number" if k == 1 else "text" for k in range(len(columns))]
    head = "".join(f'<th class="{kind}">{html.escape(name)}</th>' for kind, name in zip(kinds, columns, strict=True))
    lines = []
    for cells, missed in rows:
        data = "".join(f'<td class="{kind}">{html.escape(cell)}</td>' for kind, cell in zip(kinds, cells, strict=True))
        lines.append(f'<tr class="{"missed" if missed else "met"}">{data}</tr>')
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _png(content: Figure | np.ndarray | bytes) -> bytes:
    if isinstance(content, bytes):
        return content
    buffer = io.BytesIO()
    if isinstance(content, Figure):
        content.savefig(buffer, format="png", dpi=130)
    else:
        Image.fromarray(content).save(buffer, format="png")
    return buffer.getvalue()


_INK, _TRUTH, _ODOMETRY, _POINTS = "#1b4965", "#c1121f", "#e09f3e", "#8d99ae"
_SLICE = 0.15
_MOST_POINTS = 6_000


@dataclass(frozen=True)
class Axis:
    """A centreline to draw: label, stations (m) and positions in the survey frame (m)."""

    label: str
    station: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]


def plan_and_profile(truth: Truth, given: Axis, odometry: Axis | None) -> Figure:
    """Draws centrelines from above and from the side."""
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
    draw(given.station, given.position, color=_INK, lw=1.4, label=given.label)
    if odometry is not None:
        draw(odometry.station, odometry.position, color=_ODOMETRY, lw=1.4, ls="--", label=odometry.label)
    plan.set(title="Plan", xlabel="along the chord, m", ylabel="across, m")
    plan.set_aspect("equal", adjustable="datalim")
    profile.set(title="Profile", xlabel="station, m", ylabel="height above the start, m")
    plan.legend(fontsize=8)
    for axes in (plan, profile):
        axes.grid(alpha=0.3)
    return figure


def section_overlays(bore_path: Path, points: Float[np.ndarray, "p 3"], count: int = 4) -> Figure:
    """Draws sections of the bore over the registered points within 15 cm.

    Args:
        bore_path: `bore.npz`.
        points: Registered cloud in the tunnel frame, m.
        count: Number of sections, evenly spread.
    """
    with np.load(bore_path) as data:
        bore = {name: data[name] for name in data.files}
    rows = np.linspace(0, len(bore["station"]) - 1, count + 2).astype(int)[1:-1]
    figure, axes = plt.subplots(1, count, figsize=(3 * count, 4.4), sharey=True, layout="constrained")
    for panel, row in zip(axes, rows, strict=True):
        offset = points - bore["position"][row]
        near = offset[np.abs(offset @ bore["tangent"][row]) < _SLICE]
        near = near[np.linalg.norm(near, axis=1) < 2 * bore["radius"][row].max()]
        near = near[:: max(1, len(near) // _MOST_POINTS)]
        panel.plot(near @ bore["lateral"][row], near @ bore["up"][row], ".", ms=0.8, color=_POINTS, rasterized=True)
        angle, radius = (np.append(values, values[0]) for values in (bore["angle"], bore["radius"][row]))
        panel.plot(radius * np.cos(angle), radius * np.sin(angle), color=_INK, lw=1.2)
        panel.set(title=f"station {bore['station'][row]:.1f} m", xlabel="lateral, m", aspect="equal")
        panel.invert_xaxis()  # looking towards growing station, left is left
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("above the axis, m")
    return figure


def section_errors(comparison: Comparison) -> Figure:
    """Draws the errors of the axis and of the section's size along the tunnel."""
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(11, 4), sharex=True, layout="constrained")
    for axes, names in ((upper, ("lateral", "vertical")), (lower, ("width", "height"))):
        for name, colour in zip(names, (_INK, _ODOMETRY), strict=True):
            axes.plot(comparison.station, 100 * getattr(comparison, name), color=colour, lw=1.2, label=name)
        axes.axhline(0, color="0.6", lw=0.8)
        axes.set_ylabel("error, cm")
        axes.legend(fontsize=8, loc="upper right")
        axes.grid(alpha=0.3)
    lower.set_xlabel("station, m")
    return figure


def plan_of_walls(tunnel_path: Path, lining: str = "pockets", stretch: float = 20.0) -> Figure:
    """Draws the first metres of the planar tunnel from above, as the environment's LiDAR sees them."""
    with np.load(tunnel_path) as tunnel:
        figure, axes = plt.subplots(figsize=(11, 3), layout="constrained")
        origin, heading = tunnel["centre"][0], tunnel["tangent"][0]
        turn = np.array([heading, [-heading[1], heading[0]]])
        for side in ("left", "right"):
            wall = tunnel[f"{side}_{lining}"][tunnel[f"{side}_station_{lining}"] < stretch]
            axes.plot(*(turn @ (wall - origin).T), color=_INK, lw=1.0)
        axes.plot(*(turn @ (tunnel["centre"][tunnel["station"] < stretch] - origin).T), color=_TRUTH, lw=0.8, ls=":")
        axes.set(xlabel="m", ylabel="m", aspect="equal")
        axes.set_title(f"Walls at LiDAR height, {float(tunnel['lidar_height']):g} m above the sleepers ({lining})")
        axes.grid(alpha=0.3)
        return figure


def scene_points(scene: Path) -> Float[np.ndarray, "p 3"]:
    """Reads the registered cloud of a scene folder, thinned, in the tunnel frame, m."""
    cloud = trimesh.load(scene / "cloud.ply")
    assert isinstance(cloud, trimesh.PointCloud)  # for the type checker; the builder writes no faces
    return np.asarray(cloud.vertices)


def bore_in_perspective(bore_path: Path, eye: float = 2.0, reach: float = 40.0) -> Figure:
    """Draws the bore's sections in perspective from `eye` m inside; used where nothing can be rendered."""
    with np.load(bore_path) as data:
        bore = {name: data[name] for name in data.files}
    start = int(np.searchsorted(bore["station"], eye))
    frame = np.stack([bore["lateral"][start], bore["up"][start], bore["tangent"][start]])
    figure, axes = plt.subplots(figsize=(8, 6), layout="constrained")
    for row in range(start + 4, len(bore["station"]), 4):
        if bore["station"][row] > eye + reach:
            break
        across, along = bore["radius"][row] * np.cos(bore["angle"]), bore["radius"][row] * np.sin(bore["angle"])
        ring = bore["position"][row] + across[:, None] * bore["lateral"][row] + along[:, None] * bore["up"][row]
        left, up, ahead = frame @ (ring - bore["position"][start]).T
        shown = ahead > 0.5
        axes.plot(-left[shown] / ahead[shown], up[shown] / ahead[shown], color=_INK, lw=0.6, alpha=0.8)
    axes.set(xlim=(-1.4, 1.4), ylim=(-1.05, 1.05), aspect="equal")
    axes.set_axis_off()
    return figure


# Key in summary.json, text, unit, factor, decimals, goal, and whether less is better.
_ROWS: tuple[tuple[str, str, str, float, int, float | None, bool], ...] = (
    ("length", "Length of the true centreline", "m", 1, 2, None, True),
    ("length_error", "Reconstructed less true length", "cm", 100, 1, None, True),
    ("centreline_rmse", "Centreline RMSE, poses given", "cm", 100, 2, 5.0, True),
    ("width_rmse", "Width RMSE, poses given", "cm", 100, 2, 4.0, True),
    ("height_rmse", "Height RMSE, poses given", "cm", 100, 2, 4.0, True),
    ("coverage_mean_100", "Coverage, mean of the last 100 training episodes", "%", 100, 2, 90.0, False),
    ("success_mean_100", "Success in the last 100 training episodes", "%", 100, 1, None, False),
    ("evaluation_coverage", "Coverage in evaluation, noise-free policy", "%", 100, 2, None, False),
    ("evaluation_success", "Success in evaluation", "%", 100, 1, None, False),
    ("train_steps", "Environment steps of training", "million", 1e-6, 2, None, True),
    ("geoms", "Geoms in the scene", "", 1, 0, None, True),
    ("mesh_faces", "Triangles in the scene", "", 1, 0, None, True),
    ("seconds", "The whole demo", "s", 1, 0, 720.0, True),
)


def write_report(out: Path, summary: dict[str, Any], truth: Truth) -> Path:
    """Writes `report.html` and returns its path.

    Args:
        out: Folder of the demo; `survey`, `scene`, `scene-odometry` and `training` below it are read.
        summary: Figures in SI units.
        truth: Truth of the simulated survey.
    """
    parts = [
        html_heading("Subterra: from a recording to a trained agent", 1),
        html_paragraph("simulated survey: nothing here was measured in a real tunnel", "simulated"),
        html_heading("Figures"),
        html_table(("Figure", "Value", "Unit", "Goal"), _figure_rows(summary)),
        html_paragraph(_odometry_sentence(summary["odometry"])),
        html_heading("The bore"),
        *_bore_parts(out, summary, truth),
        html_heading("The environment and what was learnt in it"),
        html_figure(
            _closed(plan_of_walls(out / "scene" / "tunnel.npz")),
            "The first 20 m as the environment's LiDAR sees them: walls and bolt pockets at its height.",
        ),
        html_figure(
            (out / "training" / "curve.png").read_bytes(), "Coverage of each training episode and their mean of 100."
        ),
        html_heading("Where the time went"),
        html_table(("Stage", "Seconds"), [((k, f"{v:.1f}"), False) for k, v in summary["stage_seconds"].items()]),
    ]
    path = out / "report.html"
    path.write_text(html_page("Subterra demo", parts))
    return path


def _bore_parts(out: Path, summary: dict[str, Any], truth: Truth) -> list[str]:
    scene, blind = out / "scene", out / "scene-odometry"
    given = Axis("reconstructed, poses given", *centreline(scene))
    odometry = None
    if "failure" not in summary["odometry"]:
        placement = start_placement(blind / "odometry.tum", out / "survey" / "groundtruth.tum")
        odometry = Axis("reconstructed, odometry alone", *centreline(blind, placement))
    parts = []
    view = drawing.picture(scene)
    if view is not None:
        parts.append(html_figure(view, "The scene in MuJoCo, from the camera of its scout robot."))
    else:
        drawn = _closed(bore_in_perspective(scene / "bore.npz"))
        parts.append(html_figure(drawn, "The bore, drawn section by section; without OpenGL nothing can be rendered."))
    plan = _closed(plan_and_profile(truth, given, odometry))
    sections = _closed(section_overlays(scene / "bore.npz", scene_points(scene)))
    errors = _closed(section_errors(compare(scene, truth)))
    return [
        *parts,
        html_figure(plan, "Plan and profile of the centreline. Nothing is aligned: odometry starts at the true pose."),
        html_figure(sections, "Sections over the registered points within 15 cm, looking along the tunnel."),
        html_figure(errors, "Error of the axis (above) and of the section's size (below) against the truth."),
    ]


def _closed(figure: Any) -> Any:
    plt.close(figure)  # so that figures do not pile up; a closed figure can still be saved
    return figure


def _odometry_sentence(odometry: dict[str, Any]) -> str:
    if "failure" in odometry:
        return f"Without poses, by LiDAR odometry alone, no bore came out: {odometry['failure']}"
    return (
        "Without poses, by LiDAR odometry alone, started at the true pose and not aligned: centreline RMSE "
        f"{odometry['centreline_rmse']:.3f} m, length error {odometry['length_error']:+.2f} m, "
        f"width RMSE {100 * odometry['width_rmse']:.1f} cm. A smooth bore hardly constrains motion along its axis."
    )


def _figure_rows(summary: dict[str, Any]) -> list[tuple[tuple[str, ...], bool]]:
    rows: list[tuple[tuple[str, ...], bool]] = []
    for key, text, unit, factor, decimals, goal, less in _ROWS:
        value = summary.get(key)
        if value is None or not np.isfinite(value):
            rows.append(((text, "-", unit, ""), goal is not None))
            continue
        shown = factor * value
        missed = goal is not None and (shown > goal if less else shown < goal)
        sign = "≤" if less else "≥"
        rows.append(((text, f"{shown:,.{decimals}f}", unit, "" if goal is None else f"{sign} {goal:g}"), missed))
    return rows
