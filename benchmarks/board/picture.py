"""Picture of the board: a panel for each task, a bar from floor to ceiling for each kind, and a dot for each agent."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.board.cells import CEILING, Key, Score, find_leaks, keys_of, scores_of, settings_of
from benchmarks.board.roster import Group, entry_of
from benchmarks.board.tables import SPLIT
from benchmarks.results import png_bytes

# Marker, colour and name of a group; agents without a line in the roster are `other`.
_LOOKS: dict[Group, tuple[str, str, str]] = {
    "blind": ("v", "#9a9a9a", "never looks at the walls to localise"),
    "written": ("o", "#e09f3e", "written, no map"),
    "learnt": ("D", "#1b4965", "learnt, no map"),
    "reward": ("*", "#c1121f", "learnt by reward alone, no map"),
    "map": ("s", "#2a9d8f", "has the map"),
    "other": ("P", "#8367c7", "other agents"),
}
_HIDDEN: tuple[Group, ...] = ("ceiling", "truth")
_WORDS = (
    "Grey: from the floor, the most that theory allows without a look at the walls, to the ceiling, a filter that has"
    " the map and every size.\nA dot below the floor loses way at turns and boxes, or trusts a false match."
    " A dot above the ceiling is chance: both are shares of {n} episodes, whose 95 % interval is up to ± 14 %.\n"
    "{leaks}"
)


def draw(cells: Sequence[dict[str, Any]], split: str = SPLIT) -> Figure:
    """Draw one panel a task, of the kinds of one split; of all columns where nobody drove in it."""
    keys = [key for key in keys_of(cells) if key[0] == split] or keys_of(cells)
    settings = [
        s for s in settings_of(cells) if any(key in some for some in scores_of(cells, s).values() for key in keys)
    ]
    n_columns = min(5, len(settings))
    shape = (-(-len(settings) // n_columns), n_columns)
    size = (1.0 + 3.0 * max(2, n_columns), 1.8 + 2.9 * shape[0])
    figure, grid = plt.subplots(*shape, figsize=size, squeeze=False, layout="constrained", sharey=True)
    for axes, setting in zip(grid.flat, settings, strict=False):
        _panel(axes, setting.words, scores_of(cells, setting), keys)
    for axes in list(grid.flat)[len(settings) :]:
        axes.axis("off")
    for axes in grid[:, 0]:
        axes.set_ylabel("success, %")
    handles = {
        name: handle for axes in grid.flat for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=8)
    per_kind = len(cells[0]["success"]) // len(cells[0]["columns"])
    leaks = "; ".join(find_leaks(cells)) or "No dot is beyond a bound by four standard errors."
    figure.suptitle(_WORDS.format(n=per_kind, leaks=leaks), fontsize=8)
    return figure


def _panel(axes: Axes, title: str, scores: dict[str, dict[Key, Score]], keys: list[Key]) -> None:
    place = np.arange(len(keys))
    for at, key in enumerate(keys):
        bottom = next((some[key].floor for some in scores.values() if key in some), None) or 0.0
        top = scores[CEILING][key].success if key in scores.get(CEILING, {}) else 1.0
        axes.bar(at, 100.0 * max(top - bottom, 0.0), 0.9, 100.0 * bottom, color="#e3e3e3", zorder=0)
    agents = [agent for agent in scores if entry_of(agent).group not in _HIDDEN]
    aside = np.linspace(-0.28, 0.28, len(agents)) if len(agents) > 1 else np.zeros(1)
    for agent, shift in zip(agents, aside, strict=True):
        marker, colour, name = _LOOKS[entry_of(agent).group]
        height = [100.0 * scores[agent][key].success if key in scores[agent] else np.nan for key in keys]
        axes.plot(place + shift, height, marker, ms=5.0, color=colour, mec="white", mew=0.4, label=name, ls="none")
    axes.set_title(title, fontsize=10)
    axes.set_ylim(-3.0, 103.0)
    axes.set_xticks(place, [kind for _, kind in keys], rotation=90, fontsize=8)
    axes.grid(axis="y", alpha=0.3)


def as_png(cells: Sequence[dict[str, Any]]) -> bytes:
    """Return the picture as a PNG file."""
    return png_bytes(draw(cells), dpi=110)
