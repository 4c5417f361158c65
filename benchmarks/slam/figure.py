"""Errors along the axis and across it against the distance driven."""

import io

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.slam.judge import Judged

_PANELS = (("along the axis", 0), ("across it", 1))
_STYLES = ("-", "--", ":", "-.")


def draw(found: list[Judged]) -> Figure:
    """A colour for each program, a style for each recording; each panel has its own scale."""
    programs, names = (list(dict.fromkeys(values)) for values in zip(*((j.program, j.score.name) for j in found),
                                                                     strict=True))  # fmt: skip
    figure, panels = plt.subplots(2, 1, figsize=(8.0, 6.0), sharex=True, layout="constrained")
    colours = plt.get_cmap("tab10")
    for axes, (title, part) in zip(panels, _PANELS, strict=True):
        for one in found:
            style = _STYLES[names.index(one.score.name) % len(_STYLES)]
            axes.plot(
                one.curve.travelled, one.curve.error[:, part], style, color=colours(programs.index(one.program)),
                lw=1.4, label=f"{one.program}, {one.score.name}",
            )  # fmt: skip
        axes.axhline(0.0, color="0.6", lw=0.8, zorder=0)
        axes.set_ylabel(f"error {title}, m")
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("distance driven, m")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def as_png(found: list[Judged]) -> bytes:
    """The figure as a picture."""
    figure, buffer = draw(found), io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    plt.close(figure)
    return buffer.getvalue()
