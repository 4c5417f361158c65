"""Numbers of a `tunnel.npz`, written in whole units, as differences. docs/formats.md has the fields."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.host.files import replace_file

SCHEMA = "subterra.tunnel/3"
RADIUS = "shell_radius"
# m, rad or 1: half of it is the largest error. Noise makes finer radii of every degree long to write, and no
# reconstruction knows them better.
_UNIT, _RADIUS_UNIT = 1e-5, 1e-4
_EXACT = ("station", "shell_angle")  # even grids, which whole numbers would make uneven


def encode(values: Float[np.ndarray, "n ..."], unit: float) -> Int[np.ndarray, "n ..."]:
    """Return whole units as differences along the first axis, of the shortest type: small numbers, which pack well."""
    units = np.rint(values / unit).astype(np.int64)
    steps = np.diff(units, axis=0, prepend=np.zeros_like(units[:1]))
    low, high = (int(steps.min()), int(steps.max())) if steps.size else (0, 0)
    types = (np.int8, np.int16, np.int32, np.int64)
    short = next(t for t in types if np.iinfo(t).min <= low and high <= np.iinfo(t).max)
    return np.asarray(steps.astype(short))


def decode(steps: Int[np.ndarray, "n ..."], unit: float) -> Float[np.ndarray, "n ..."]:
    """Return the values of `encode`, within half a unit."""
    return np.asarray(unit * steps.astype(np.int64).cumsum(axis=0), np.float64)


def unit_field(field: str) -> str:
    """Return the field that holds the unit of another one's whole numbers."""
    return "shell_unit" if field.startswith(RADIUS) else "unit"


def read_fields(path: Path) -> dict[str, np.ndarray]:
    """Return all fields of a tunnel file by name, those in whole units as the numbers that they stand for."""
    with np.load(path) as data:
        fields = {name: data[name] for name in data.files}
    whole = [name for name, values in fields.items() if values.ndim and values.dtype.kind == "i"]
    return fields | {name: decode(fields[name], float(fields[unit_field(name)])) for name in whole}


def write_tunnel(path: Path, facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a tunnel file; the same content gives the same bytes.

    Args:
        facts: Words and single numbers by field, which are kept as they are.
        arrays: Numbers by field, which are rounded: radii to 0.1 mm, others to 1e-5 m or rad.
    """
    units = {"unit": _UNIT, "shell_unit": _RADIUS_UNIT}
    whole = {}
    for field, values in arrays.items():
        steps = values if field in _EXACT else encode(values, units[unit_field(field)])
        # Neighbours are alike around the bore, and down the columns of a table: so the file is a third smaller.
        whole[field] = steps if field.startswith(RADIUS) else np.asfortranarray(steps)
    used = {unit_field(field) for field in arrays}
    fields: dict[str, Any] = {"schema": SCHEMA, **facts, **{name: units[name] for name in sorted(used)}}
    with replace_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **{field: np.array(value) for field, value in fields.items()}, **whole)  # type: ignore[arg-type]
