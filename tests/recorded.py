"""Tables of what the same input gave before; a number that moves on purpose is written anew, with the reason.

`SUBTERRA_WRITE_VALUES=1 pytest FILE` writes the tables of a file's tests.
"""

import csv
import os
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.text import Text

_FEW = 6
_MODEL = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "geom_type", "geom_pos", "geom_quat", "geom_size",
    "geom_friction", "geom_solref", "geom_rgba", "geom_contype", "geom_conaffinity", "jnt_axis", "jnt_range",
    "dof_damping", "dof_armature", "actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange",
    "mesh_vertnum", "mat_rgba", "cam_pos", "light_pos"
)  # fmt: skip


def figures(value: Any, place: str = "") -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Place and contents of all numbers and words of a tree.

    An array is told by its shape, its mean, its mean weighted by a wave along its flat index, which moves with any
    element, and its mean size, by which both are compared.
    """
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, dict):
        for name, one in value.items():
            yield from figures(one, f"{place}.{name}".lstrip("."))
    elif isinstance(value, tuple | list) and value and all(isinstance(one, dict) for one in value):
        names = dict.fromkeys(name for one in value for name in one)
        yield from figures({name: [one.get(name) for one in value] for name in names}, place)
    elif isinstance(value, tuple | list) and (len(value) <= _FEW or not _is_array(value)):
        if all(isinstance(one, str | None) for one in value):
            yield place, (" ".join(dict.fromkeys(map(str, value))),)
        else:
            for number, one in enumerate(value):
                yield from figures(one, f"{place}.{number}")
    elif value is None or isinstance(value, str):
        yield place, (value or "",)
    elif np.asarray(value).dtype.names:
        yield from figures({name: value[name] for name in value.dtype.names}, place)
    elif np.ndim(value) > 1 and np.shape(value)[-1] <= _FEW:  # columns may differ in size
        for number, column in enumerate(np.moveaxis(np.asarray(value), -1, 0)):
            yield from figures(column, f"{place}.{number}")
    elif np.asarray(value).dtype.kind in "biuf":
        array = np.asarray(value, np.float64).ravel()
        known = np.isfinite(array)
        wave = np.cos(0.7 * np.arange(array.size))[known]
        shape = f"{'x'.join(map(str, np.shape(value)))} {known.sum()}"
        array = array[known] if known.any() else np.zeros(1)
        mixed = float(np.mean(array * wave)) if known.any() else 0.0
        yield place, (shape, float(array.mean()), mixed, float(np.abs(array).mean()))


def _is_array(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "biuf"
    except ValueError:  # rows of several lengths
        return False


def check(table: Path | str, name: str, value: Any, rel: float = 1e-4) -> None:
    """A tree is what the table, or that beside a test's file, holds under a name; numbers within `rel` of its size."""
    table = Path(table).with_suffix(".csv")
    now = dict(figures(value, name))
    rows = list(csv.reader(table.open(newline=""))) if table.exists() else []
    if os.environ.get("SUBTERRA_WRITE_VALUES"):
        kept = [row for row in rows if row[0].partition(".")[0] != name]
        new = [
            (place, *(f"{one:.7g}" if isinstance(one, float) else one for one in told)) for place, told in now.items()
        ]
        with table.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(sorted([*kept, *new], key=lambda row: row[0]))
        return
    before = {row[0]: row[1:] for row in rows if row[0].partition(".")[0] == name}
    moved = [place for place in sorted({*before, *now}) if not _same(before.get(place, []), now.get(place, ()), rel)]
    assert not moved, "\n".join(f"{place}: {before.get(place)} -> {now.get(place)}" for place in moved[:20])


def _same(before: list[str], now: tuple[Any, ...], rel: float) -> bool:
    if len(before) != len(now) or before[0] != now[0]:
        return False
    near = rel * now[3] + 1e-9 if len(now) == 4 else 0.0
    return all(abs(float(one) - other) <= near for one, other in zip(before[1:], now[1:], strict=True))


def arrays_of(model: Any) -> dict[str, np.ndarray]:
    """Arrays of a MuJoCo model that say what stands where, how heavy and how driven."""
    return {name: getattr(model, name) for name in _MODEL}


def named(tree):
    """Leaves of a tree by their paths."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator=" "): np.asarray(leaf, float) for path, leaf in leaves}


def drawn(figure: Any) -> dict[str, Any]:
    """Words of a figure, and where its lines, areas, bars and pictures lie in the units of its axes."""
    found: dict[str, Any] = {"words": "; ".join(text.get_text() for text in figure.findobj(Text) if text.get_text())}
    for number, axes in enumerate(figure.axes):
        parts = [(one.get_transform(), one.get_path()) for one in (*axes.lines, *axes.patches)]
        parts += [(one.get_transform(), path) for one in axes.collections for path in one.get_paths()]
        corners = [np.nan_to_num((frame - axes.transData).transform(path.vertices), nan=-99.0) for frame, path in parts]
        found |= {f"{number} corners": np.concatenate([*corners, np.zeros((0, 2))]), f"{number} limits": axes.axis()}
        found |= {f"{number} picture {k}": np.nan_to_num(one.get_array()) for k, one in enumerate(axes.images)}
    return found


def lines_of(records: list[Any]) -> str:
    """Records of measurements as text, without where and when they were measured."""
    here = {"versions": {}, "date": "", "hardware": "", "commit": ""}
    return "\n".join(str(replace(record, **here)).removeprefix("Record") for record in records)
