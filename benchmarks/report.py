"""The demo's report: what was reconstructed, how true it is, what was learnt on it."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks import figures, page, render
from benchmarks.truth import Truth, centreline, compare, start_placement

# Figure in summary.json, what it is, unit, factor, decimals, goal and whether less is better.
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
        out: The demo's folder: `survey`, `scene`, `scene-odometry`, `training` below it are read.
        summary: The figures, SI.
        truth: Of the simulated survey.
    """
    parts = [
        page.heading("Subterra: from a recording to a trained agent", 1),
        page.paragraph("simulated survey: nothing here was measured in a real tunnel", "simulated"),
        page.heading("Figures"),
        page.table(("Figure", "Value", "Unit", "Goal"), _figure_rows(summary)),
        page.paragraph(_odometry_sentence(summary["odometry"])),
        page.heading("The bore"),
        *_bore_parts(out, summary, truth),
        page.heading("The environment and what was learnt in it"),
        page.figure(_closed(figures.drawn_view(out / "scene" / "tunnel.npz")), _caption_walls()),
        page.figure(
            (out / "training" / "curve.png").read_bytes(), "Coverage of each training episode and their mean of 100."
        ),
        page.heading("Where the time went"),
        page.table(("Stage", "Seconds"), [((k, f"{v:.1f}"), False) for k, v in summary["stage_seconds"].items()]),
    ]
    path = out / "report.html"
    path.write_text(page.page("Subterra demo", parts))
    return path


def _bore_parts(out: Path, summary: dict[str, Any], truth: Truth) -> list[str]:
    scene, blind = out / "scene", out / "scene-odometry"
    given = figures.Axis("reconstructed, poses given", *centreline(scene))
    odometry = None
    if "failure" not in summary["odometry"]:
        placement = start_placement(blind / "odometry.tum", out / "survey" / "groundtruth.tum")
        odometry = figures.Axis("reconstructed, odometry alone", *centreline(blind, placement))
    parts = []
    view = render.picture(scene)
    if view is not None:
        parts.append(page.figure(view, "The scene in MuJoCo, from the camera of its scout robot."))
    else:
        drawn = _closed(figures.drawn_bore(scene / "bore.npz"))
        parts.append(page.figure(drawn, "The bore, drawn section by section; no OpenGL was to be had for a rendering."))
    plan = figures.plan_and_profile(truth, given, odometry)
    sections = figures.section_overlays(scene / "bore.npz", figures.scene_points(scene))
    errors = figures.section_errors(compare(scene, truth))
    return [
        *parts,
        page.figure(
            _closed(plan),
            "Plan and profile of the centreline. Nothing is aligned: the odometry starts at the true pose.",
        ),
        page.figure(_closed(sections), "Sections over the registered points within 15 cm, looking along the tunnel."),
        page.figure(_closed(errors), "Error of the axis (above) and of the section's size (below) against the truth."),
    ]


def _closed(figure: Any) -> Any:
    plt.close(figure)  # so that figures do not pile up; the object can still be saved
    return figure


def _caption_walls() -> str:
    return "The first 20 m as the environment's LiDAR sees them: walls and bolt pockets at its height."


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
