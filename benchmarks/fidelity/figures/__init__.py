"""The figures of a report; a figure whose material is missing is left out with its reason."""

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

from benchmarks.fidelity.figures.errors import (
    draw_depth_maps,
    draw_error_distribution,
    draw_errors_along,
    draw_mismatch,
    draw_projections,
    draw_sections,
    draw_signed_errors,
)
from benchmarks.fidelity.figures.sheet import Draw, Sheet, draw_categories, draw_controls, draw_sweep
from benchmarks.fidelity.figures.tunnel import (
    draw_axis,
    draw_degeneracy,
    draw_free_space,
    draw_persistence,
    draw_range_image,
    draw_sensor_distributions,
    draw_unrolled,
    draw_worst_places,
)
from benchmarks.fidelity.table import Need

matplotlib.use("Agg")

FIGURES: tuple[tuple[str, Draw, Need | None], ...] = (  # with the reference that each cannot do without
    ("F17-unrolled", draw_unrolled, "reference"),
    ("F18-worst-places", draw_worst_places, "reference"),
    ("F13-categories", draw_categories, None),
    ("F14-controls", draw_controls, None),
    ("F15-sweep", draw_sweep, None),
    ("F01-voxels", draw_projections, "hold"),
    ("F02-mismatch", draw_mismatch, "hold"),
    ("F03-signed-error", draw_signed_errors, "hold"),
    ("F04-along-chainage", draw_errors_along, "hold"),
    ("F05-sections", draw_sections, "reference"),
    ("F06-depth-maps", draw_depth_maps, "hold"),
    ("F07-distribution", draw_error_distribution, "hold"),
    ("F08-range-image", draw_range_image, "hold"),
    ("F09-sensor", draw_sensor_distributions, "hold"),
    ("F10-persistence", draw_persistence, "reference"),
    ("F11-free-space", draw_free_space, "reference"),
    ("F12-degeneracy", draw_degeneracy, "hold"),
    ("F16-axis", draw_axis, "reference"),
)


def draw_all(folder: Path, sheet: Sheet) -> dict[str, tuple[Path, str]]:
    """Writes each figure as PNG and SVG.

    Args:
        folder: Folder to write to.
        sheet: Material of the figures.

    Returns:
        PNG file and caption by name, in order.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = {}
    with plt.rc_context(
        {"svg.hashsalt": "subterra", "font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    ):
        for name, draw, need in FIGURES:
            if not sheet.case.has(need):
                continue
            try:
                drawn = draw(sheet)
            except Exception as error:  # a recording that shows too little, or a spoilt candidate, costs its own figure
                print(f"{name} is left out: {error}", flush=True)
                plt.close("all")
                continue
            if drawn is None:
                continue
            figure, caption = drawn
            for suffix in ("svg", "png"):
                path = folder / f"{name}.{suffix}"
                figure.savefig(path, dpi=130, metadata={"Date": None} if suffix == "svg" else None)
                figure.set_layout_engine("none")  # laid out by the first: to do so takes as long as to draw
            plt.close(figure)
            written[name] = (folder / f"{name}.png", caption)
    return written
