"""Picture of the board: a panel for each task, a row for each agent, between the floor and the ceiling."""

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.board.cells import CEILING, Cells, Key, find_leaks, keys_of, setting_of, settings_of, summarise
from benchmarks.board.roster import Group, entry_of
from benchmarks.board.tables import SPLIT

# Marker, colour and name of a group; agents without a line in the roster are `other`.
_LOOKS: dict[Group, tuple[str, str, str]] = {
    "blind": ("v", "#7a7a7a", "never looks at the walls to localise"),
    "written": ("o", "#c77700", "written, no map"),
    "learnt": ("D", "#1b4965", "learnt, no map"),
    "reward": ("*", "#c1121f", "learnt by reward alone, no map"),
    "map": ("s", "#1f8a7d", "has the map"),
    "other": ("P", "#8367c7", "other agents"),
}
_WORDS = (
    "Success over the {kinds} with its 95 % interval; small dots: one kind each. Grey: from the floor, the most that"
    " theory allows without a look at the walls,\nto the ceiling, a filter that has the map and every size. An agent"
    " below the floor loses way at turns and boxes or trusts a false match; one above the ceiling is so by chance.\n"
    "{leaks}"
)


def draw(cells: Cells, split: str = SPLIT) -> Figure:
    """Draw one panel a task, of the kinds of one split; of all columns where nobody drove in it."""
    keys = [key for key in keys_of(cells) if key[0] == split] or keys_of(cells)
    cells = [cell for cell in cells if summarise(cell, keys) is not None]
    settings = settings_of(cells)
    n_columns = min(3, len(settings))
    shape = (-(-len(settings) // n_columns), n_columns)
    size = (1.0 + 4.0 * max(2, n_columns), 1.6 + 2.3 * shape[0])
    figure, grid = plt.subplots(*shape, figsize=size, squeeze=False, layout="constrained", sharex=True)
    for axes, setting in zip(grid.flat, settings, strict=False):
        _panel(axes, setting.words, [cell for cell in cells if setting_of(cell) == setting], keys)
    for axes in list(grid.flat)[len(settings) :]:
        axes.axis("off")
    for axes in grid[-1]:
        axes.set_xlabel("success, %")
    found = (zip(*axes.get_legend_handles_labels(), strict=True) for axes in grid.flat)
    handles = {name: handle for pairs in found for handle, name in pairs}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize=9)
    leaks = "; ".join(find_leaks(cells)) or "No figure is beyond a bound by four standard errors."
    kinds = f"{len(keys)} kinds of {split}" if keys[0][0] == split else f"{len(keys)} columns"
    figure.suptitle(_WORDS.format(kinds=kinds, leaks=leaks), fontsize=9)
    return figure


def _panel(axes: Axes, title: str, cells: Cells, keys: list[Key]) -> None:
    shown = [cell for cell in cells if entry_of(cell["agent"]).group not in ("ceiling", "truth")]
    for row, cell in enumerate(shown):
        marker, colour, name = _LOOKS[entry_of(cell["agent"]).group]
        whole, each = summarise(cell, keys), [summarise(cell, (key,)) for key in keys]
        assert whole is not None
        parts = [100.0 * one.success for one in each if one is not None]
        axes.plot(parts, [row] * len(parts), ".", ms=5, color=colour, alpha=0.35, mew=0)
        ends = [[100.0 * max(whole.success - whole.low, 0.0)], [100.0 * max(whole.high - whole.success, 0.0)]]
        axes.errorbar(100.0 * whole.success, row, xerr=ends, fmt=marker, ms=7, lw=1.5, color=colour, mec="white",
                      mew=0.5, label=name)  # fmt: skip
    floor = next((one.floor for cell in cells if (one := summarise(cell, keys)) is not None), None) or 0.0
    top = next((one for cell in cells if cell["agent"] == CEILING and (one := summarise(cell, keys))), None)
    ceiling = 1.0 if top is None else top.success
    axes.axvspan(100.0 * floor, 100.0 * ceiling, color="#e9e9e9", zorder=0)
    for place, name in ((floor, "floor"), (ceiling, "ceiling")):
        axes.axvline(100.0 * place, color="#555555", lw=1.0, ls="--", zorder=1)
        axes.text(100.0 * place, -0.62, f"{name} {100 * place:.0f}", ha="center", va="bottom", fontsize=7.5)
    axes.set_title(title, fontsize=11, pad=12)
    axes.set(xlim=(-3.0, 104.0), ylim=(len(shown) - 0.4, -0.6))
    axes.set_yticks(range(len(shown)), [cell["agent"] for cell in shown], fontsize=8.5)
    for label, cell in zip(axes.get_yticklabels(), shown, strict=True):
        label.set_color(_LOOKS[entry_of(cell["agent"]).group][1])
    axes.grid(axis="x", alpha=0.3)
