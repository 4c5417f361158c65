"""Success of every agent on every task, with intervals."""

import io
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

_COLUMNS = 4


def draw(rows: list[dict[str, Any]], facts: dict[str, Any]) -> Figure:
    """One panel for each task, agents down the side; worlds by colour."""
    tasks, agents, worlds = (list(dict.fromkeys(row[key] for row in rows)) for key in ("task", "agent", "world"))
    n_columns = min(_COLUMNS, len(tasks))
    n_rows = -(-len(tasks) // n_columns)
    size = (2.0 + 3.0 * n_columns, 0.8 + n_rows * (0.7 + 0.24 * len(agents) * max(1, 0.7 * len(worlds))))
    figure, grid = plt.subplots(n_rows, n_columns, figsize=size, sharex=True, sharey=True, squeeze=False,
                                layout="constrained")  # fmt: skip
    colours = plt.get_cmap("tab10")
    height = 0.8 / len(worlds)
    for axes, task in zip(grid.flat, tasks, strict=False):
        for i, world in enumerate(worlds):
            mine = [row for row in rows if (row["task"], row["world"]) == (task, world)]
            place = np.array([agents.index(row["agent"]) for row in mine]) + height * (i - 0.5 * (len(worlds) - 1))
            success, low, high = (100.0 * np.array([row[k] for row in mine]) for k in
                                  ("success", "success_low", "success_high"))  # fmt: skip
            spread = np.maximum([success - low, high - success], 0.0)
            axes.barh(place, success, height, color=colours(i), alpha=0.75, label=world)
            axes.errorbar(success, place, xerr=spread, fmt="none", ecolor="0.2", elinewidth=1.0, capsize=2.0)
        axes.set_title(task.removeprefix("Subterra/"), fontsize=9)
        axes.set_yticks(range(len(agents)), agents, fontsize=8)
        axes.set_xlim(0.0, 103.0)
        axes.tick_params(labelbottom=True, labelsize=8)
        axes.grid(axis="x", alpha=0.3)
    grid[0, 0].invert_yaxis()
    for axes in list(grid.flat)[len(tasks) :]:
        axes.axis("off")
    if len(worlds) > 1:
        figure.legend(
            *grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(worlds), fontsize=8
        )
    title = "" if len(worlds) > 1 else f"{worlds[0]}; "
    figure.suptitle(f"{title}{facts['episodes']} episodes a task; success, %, with 95 % intervals", fontsize=10)
    return figure


def as_png(rows: list[dict[str, Any]], facts: dict[str, Any]) -> bytes:
    """The figure as a picture."""
    figure, buffer = draw(rows, facts), io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    plt.close(figure)
    return buffer.getvalue()
