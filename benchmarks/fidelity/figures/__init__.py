"""The figures of a judgement, one file a theme; each is left out, with its reason, where what it shows is not there."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.fidelity.case import Case


@dataclass(frozen=True)
class Sheet:
    """What figures draw from.

    Attributes:
        case: What was judged.
        null: The same with the null tube in its place.
        report: See `report.content`.
        controls: Rows of controls; may be empty.
        sweep: Rows of the sweep; may be empty.
    """

    case: Case
    null: Case
    report: dict[str, Any]
    controls: list[dict[str, Any]]
    sweep: list[dict[str, Any]]

    def note(self, n: int | None = None) -> str:
        """What every caption ends with: samples, seed, split."""
        hold = self.report["split"]["hold"]
        split = (
            f"held out: {hold['file']}" if hold and hold["file"] else "held-out beams" if hold else "nothing held out"
        )
        return (
            f" n = {n:,}." if n is not None else ""
        ) + f" Seed {self.report['seed']}; {split}; split {self.report['split']['rule']}."


Drawn = tuple[Figure, str]
Draw = Callable[[Sheet], Drawn | None]


def draw_all(folder: Path, sheet: Sheet) -> dict[str, tuple[Path, str]]:
    """Writes each figure as PNG and SVG.

    Args:
        folder: To write to.
        sheet: What to draw from.

    Returns:
        PNG file and caption by name, in order.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = {}
    with plt.rc_context(
        {"svg.hashsalt": "subterra", "font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    ):
        for name, draw in _figures():
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
            plt.close(figure)
            written[name] = (folder / f"{name}.png", caption)
    return written


def _figures() -> Iterator[tuple[str, Draw]]:
    from benchmarks.fidelity.figures import (
        axis,
        beams,
        degeneracy,
        errors,
        freespace,
        scores,
        sections,
        topology,
        voxels,
    )

    yield "F13-categories", scores.categories
    yield "F14-controls", scores.heat_map
    yield "F15-sweep", scores.strips
    yield "F01-voxels", voxels.projections
    yield "F02-mismatch", voxels.mismatch
    yield "F03-signed-error", errors.unrolled
    yield "F04-along-chainage", errors.along
    yield "F05-sections", sections.overlays
    yield "F06-depth-maps", sections.depth_maps
    yield "F07-distribution", errors.distribution
    yield "F08-range-image", beams.range_image
    yield "F09-sensor", beams.distributions
    yield "F10-persistence", topology.diagrams
    yield "F11-free-space", freespace.plan
    yield "F12-degeneracy", degeneracy.along
    yield "F16-axis", axis.plan_and_profile
