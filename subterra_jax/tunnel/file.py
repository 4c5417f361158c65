"""`tunnel.npz`: a plan with all its linings and, where known, its bore in three dimensions; see docs/formats.md.

A complaint about a file names the file and the field.
"""

import dataclasses
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.tunnelfile import RADIUS, SCHEMA, decode, unit_field
from subterra_jax.host.versions import BUILD_AGAIN, other_schema
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall
from subterra_jax.tunnel.shell import N_BRICK, SPACING, Shell, ShellLining


def describe_damage(path: Path, error: Exception) -> str:
    """Say why an archive cannot be read; NumPy's own message takes every other file for a pickle."""
    if path.is_dir():
        return "it is a folder without a tunnel.npz"
    return str(error) if path.stat().st_size and zipfile.is_zipfile(path) else "it is no zip file, or is cut short"


class _Fields:
    """Checked access to the fields of one tunnel file."""

    def __init__(self, path: Path):
        self.path = path
        try:
            with np.load(path, allow_pickle=False) as data:
                self.data = {name: data[name] for name in data.files}
        except FileNotFoundError as error:
            raise TunnelError(f"{path}: no such tunnel file") from error
        except Exception as error:  # zipfile, zlib and NumPy each raise their own for a damaged archive
            raise TunnelError(f"{path}: not a readable .npz archive ({describe_damage(path, error)})") from error

    def fail(self, field: str, problem: str) -> TunnelError:
        return TunnelError(f"{self.path}: field '{field}' {problem}")

    def text(self, field: str) -> str:
        if field not in self.data:
            raise self.fail(field, "is missing")
        if self.data[field].shape != () or self.data[field].dtype.kind != "U":
            raise self.fail(field, f"must be one string, is {self.data[field].dtype} of shape {self.data[field].shape}")
        return str(self.data[field])

    def numbers(self, field: str, *shape: int | None) -> np.ndarray:
        """Return a finite float64 array of the given shape; `None` stands for any size."""
        if field not in self.data:
            raise self.fail(field, "is missing")
        value = self.data[field]
        if value.dtype.kind not in "fiu":
            raise self.fail(field, f"must hold numbers, holds {value.dtype}")
        if value.ndim != len(shape) or any(w is not None and w != h for w, h in zip(shape, value.shape, strict=True)):
            needed = ", ".join("any" if w is None else str(w) for w in shape)
            raise self.fail(field, f"must have shape ({needed}), has {value.shape}")
        if not np.all(np.isfinite(value)):
            where = np.argwhere(~np.isfinite(value))[0].tolist()
            raise self.fail(field, f"has a value that is not finite, at index {where}")
        if value.ndim and value.dtype.kind in "iu" and "unit" in self.data:
            return decode(value, self.number(unit_field(field)))
        return value.astype(np.float64)

    def number(self, field: str, otherwise: float | None = None) -> float:
        """Return one number; `otherwise` where the file does not have it."""
        return otherwise if otherwise is not None and field not in self.data else float(self.numbers(field))

    def wall(self, side: str, lining: str) -> Wall:
        field = f"{side}_{lining}"
        vertex = self.numbers(field, None, 2)
        if len(vertex) < 2:
            raise self.fail(field, f"needs at least 2 vertices, has {len(vertex)}")
        station = self.numbers(f"{side}_station_{lining}", len(vertex))
        if np.any(np.diff(station) < 0.0):
            raise self.fail(f"{side}_station_{lining}", f"decreases at index {np.argmax(np.diff(station) < 0.0)}")
        return Wall(vertex, station)


def read_tunnel(path: Path) -> TunnelPlan:
    """Read and check a `tunnel.npz`.

    Raises:
        TunnelError: The file cannot be read, or a field is missing or wrong.
    """
    fields = _Fields(path)
    if (schema := fields.text("schema")) != SCHEMA:
        raise TunnelError(f"{path}: {other_schema(schema, SCHEMA, BUILD_AGAIN)}")
    axis = _read_axis(fields)
    ring_pitch = fields.number("ring_pitch", 0.0)
    if ring_pitch < 0.0:
        raise fields.fail("ring_pitch", f"must not be negative, is {ring_pitch}")
    plan = TunnelPlan(
        name=fields.text("name"),
        provenance=fields.text("provenance"),
        **axis,
        lidar_height=fields.number("lidar_height"),
        linings=_read_linings(fields),
        ring_pitch=ring_pitch,
        source=str(path),
        texture=int(fields.number("texture")) if "texture" in fields.data else None,
    )
    if any(name.startswith("shell_") for name in fields.data):
        plan = dataclasses.replace(plan, shell=_read_shell(fields, plan))
    _check_sides(fields, plan)
    return plan


def _read_axis(fields: _Fields) -> dict[str, Any]:
    """Read what a plan knows at each station: the centreline and the width around it."""
    station = fields.numbers("station", None)
    n = len(station)
    if n < 2:
        raise fields.fail("station", f"needs at least 2 values, has {n}")
    step = np.diff(station)
    if station[0] != 0.0 or np.any(step <= 0.0) or np.any(np.abs(step - step.mean()) > 1e-6 * station[-1]):
        raise fields.fail("station", "must be a uniform, growing grid that starts at 0")
    centre, tangent = fields.numbers("centre", n, 2), fields.numbers("tangent", n, 2)
    size = np.linalg.norm(tangent, axis=1)
    if np.any(np.abs(size - 1.0) > 1e-3):
        raise fields.fail("tangent", "must hold unit vectors")
    against = np.sum(np.gradient(centre, axis=0) * tangent, axis=1) <= 0.0
    if np.any(against):
        raise fields.fail("tangent", f"is flipped at index {np.argmax(against)}: it points against the centreline")
    half_width = fields.numbers("half_width", n)
    if np.any(half_width <= 0.0):
        raise fields.fail("half_width", "must be positive")
    return {
        "station": station,
        "centre": centre,
        "tangent": tangent / size[:, None],
        "elevation": fields.numbers("elevation", n),
        "half_width": half_width,
    }


def _read_linings(fields: _Fields) -> dict[str, Lining]:
    """Read every lining variant by its name."""
    names: Any = fields.data.get("lining")
    if names is None:
        raise fields.fail("lining", "is missing")
    if names.ndim != 1 or names.dtype.kind != "U" or len(names) == 0:
        raise fields.fail("lining", f"must be a list of names, is {names.dtype} of shape {names.shape}")
    return {
        str(name): Lining(
            fields.wall("left", name), fields.wall("right", name), fields.numbers(f"furniture_{name}", None, 4)
        )
        for name in names
    }


def _check_sides(fields: _Fields, plan: TunnelPlan) -> None:
    """Refuse a wall that lies to the other side of the centreline."""
    for name, lining in plan.linings.items():
        for side, wall, sign in (("left", lining.left, 1.0), ("right", lining.right, -1.0)):
            if np.median(sign * _lateral(plan, wall)) <= 0.0:
                raise fields.fail(
                    f"{side}_{name}", f"lies to the other side of the centreline: {side} means its {side}"
                )


def _lateral(plan: TunnelPlan, wall: Wall) -> np.ndarray:
    """Return the distances of a wall's vertices to the left of the centreline, m."""
    x, y, tangent_x, tangent_y = (
        np.interp(wall.station, plan.station, column) for column in (*plan.centre.T, *plan.tangent.T)
    )
    return tangent_x * (wall.vertex[:, 1] - y) - tangent_y * (wall.vertex[:, 0] - x)


def _read_shell(fields: _Fields, plan: TunnelPlan) -> Shell:
    n = len(plan.station)
    angle, rise = fields.numbers("shell_angle", None), fields.numbers("shell_rise", n)
    m = len(angle)
    step = np.diff(angle, append=angle[:1] + 2 * np.pi) if m else np.zeros(1)
    if m < 8 or np.any(np.abs(step - 2 * np.pi / m) > 1e-6):
        raise fields.fail("shell_angle", "must hold at least 8 even directions over one turn")
    if np.any(np.abs(rise) >= 1.0):
        raise fields.fail("shell_rise", "must be above -1 and below 1")

    def distances(field: str, *shape: int) -> np.ndarray:
        values = fields.numbers(field, *shape)
        if not np.all(values > 0.0):
            raise fields.fail(field, "must give positive distances from the axis")
        return values

    level = np.sqrt(1.0 - rise**2)[:, None]
    return Shell(
        station=plan.station,
        position=np.column_stack([plan.centre, plan.elevation + fields.numbers("shell_height", n)]),
        tangent=np.column_stack([level * plan.tangent, rise]),
        angle=angle,
        radius=distances(RADIUS, n, m),
        section=distances("shell_section", m),
        track=fields.numbers("shell_track", None, N_BRICK),
        linings={
            name: ShellLining(
                fields.numbers(f"shell_pocket_{name}", None, 5),
                fields.numbers(f"shell_brick_{name}", None, N_BRICK),
                fields.number(f"shell_seam_{name}"),
                distances(f"{RADIUS}_{name}", n, m) if f"{RADIUS}_{name}" in fields.data else None,
            )
            for name in plan.linings
        },
        spacing=_read_spacing(fields),
    )


def _read_spacing(fields: _Fields) -> tuple[float, float]:
    """Read the spacing of the shell's vertices, m; without the field it is that of scenes."""
    if "shell_spacing" not in fields.data:
        return SPACING
    along, around = fields.numbers("shell_spacing", 2).tolist()
    if min(along, around) <= 0.0:
        raise fields.fail("shell_spacing", "must be positive")
    return along, around
