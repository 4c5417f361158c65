"""The figures of a report; a figure whose material is missing is left out with its reason."""

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

from benchmarks.fidelity.figures import errors, tunnel
from benchmarks.fidelity.figures.sheet import Draw, Sheet, draw_categories, draw_controls, draw_sweep
from benchmarks.fidelity.table import Need

matplotlib.use("Agg")

FIGURES: tuple[tuple[str, Draw, Need | None], ...] = (  # with the reference that each cannot do without
    ("F17-unrolled", tunnel.draw_unrolled, "reference"),
    ("F18-worst-places", tunnel.draw_worst_places, "reference"),
    ("F13-categories", draw_categories, None),
    ("F14-controls", draw_controls, None),
    ("F15-sweep", draw_sweep, None),
    ("F01-voxels", errors.draw_projections, "hold"),
    ("F02-mismatch", errors.draw_mismatch, "hold"),
    ("F03-signed-error", errors.draw_signed_errors, "hold"),
    ("F04-along-chainage", errors.draw_errors_along, "hold"),
    ("F05-sections", errors.draw_sections, "reference"),
    ("F06-depth-maps", errors.draw_depth_maps, "hold"),
    ("F07-distribution", errors.draw_error_distribution, "hold"),
    ("F08-range-image", tunnel.draw_range_image, "hold"),
    ("F09-sensor", tunnel.draw_sensor_distributions, "hold"),
    ("F10-persistence", tunnel.draw_persistence, "reference"),
    ("F11-free-space", tunnel.draw_free_space, "reference"),
    ("F12-degeneracy", tunnel.draw_degeneracy, "hold"),
    ("F16-axis", tunnel.draw_axis, "reference"),
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
