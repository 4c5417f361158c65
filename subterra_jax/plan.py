"""The planar tunnel as its file describes it: float64 NumPy on the host, every lining variant, checked on reading."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from subterra_jax.errors import TunnelError

SCHEMA = "subterra.tunnel/1"
PACKAGED = ("subterra-351", "metro-asbuilt")  # the first is the default
GENERATED = re.compile(r"control|procedural:.*")  # names of tunnels that are made, not read


@dataclasses.dataclass(frozen=True)
class Wall:
    """One wall as an open polyline in the direction of growing station.

    Attributes:
        vertex: Vertices in the tunnel frame, m, `(k, 2)`.
        station: Station of each vertex, m, `(k,)`, not decreasing.
    """

    vertex: np.ndarray
    station: np.ndarray


@dataclasses.dataclass(frozen=True)
class Lining:
    """One variant of the walls.

    Attributes:
        left: The wall on the left of growing station.
        right: The wall on the right.
        furniture: Further wall segments `x0, y0, x1, y1`, m, `(f, 4)`; may be empty.
    """

    left: Wall
    right: Wall
    furniture: np.ndarray

    @property
    def segments(self) -> np.ndarray:
        """Every wall segment as `x0, y0, x1, y1`, m, `(n, 4)`: the geometry that a LiDAR here must agree with."""
        chains = [np.hstack([wall.vertex[:-1], wall.vertex[1:]]) for wall in (self.left, self.right)]
        return np.concatenate([*chains, self.furniture])


@dataclasses.dataclass(frozen=True)
class TunnelPlan:
    """A tunnel file in memory.

    Attributes:
        name: Name for people.
        provenance: `measured` or `simulated`.
        station: Uniform chainage grid from 0 to the length, m, `(n,)`.
        centre: Centreline, m, `(n, 2)`.
        tangent: Unit tangent of the centreline, `(n, 2)`.
        elevation: Height of the ground the robot drives on, m, `(n,)`.
        half_width: Half the distance between the smooth walls, m, `(n,)`.
        lidar_height: Height of the LiDAR plane above `elevation`, m.
        linings: Variant name to its walls.
        ring_pitch: Distance from ring joint to ring joint, at which the pockets repeat, m; 0 where there are no rings
            or nobody said.
    """

    name: str
    provenance: str
    station: np.ndarray
    centre: np.ndarray
    tangent: np.ndarray
    elevation: np.ndarray
    half_width: np.ndarray
    lidar_height: float
    linings: dict[str, Lining]
    ring_pitch: float = 0.0

    @property
    def length(self) -> float:
        """Length of the centreline, m."""
        return float(self.station[-1])

    @property
    def default_lining(self) -> str:
        """The variant to use where nobody said: `pockets`, or the first where there are none."""
        return "pockets" if "pockets" in self.linings else next(iter(self.linings))

    def lining(self, name: str) -> Lining:
        """The walls of one variant; raises `TunnelError` naming the variants there are."""
        if name not in self.linings:
            raise TunnelError(f"tunnel {self.name!r} has no lining {name!r}; it has {', '.join(self.linings)}")
        return self.linings[name]

    def slice(self, start: float, length: float) -> TunnelPlan:
        """The piece from `start` to `start + length`, its stations counted from 0 and both its mouths open.

        Args:
            start: Station at which the piece begins, m.
            length: Length of the piece, m; the chainage grid keeps its spacing as nearly as a uniform grid allows.

        Raises:
            ValueError: The piece does not lie within the tunnel.
        """
        end = start + length
        if not (0.0 <= start < end <= self.length + 1e-9):
            raise ValueError(f"slice {start}..{end} m does not lie within the tunnel's 0..{self.length} m")
        spacing = self.station[1] - self.station[0]
        station = np.linspace(start, end, max(2, round(length / spacing) + 1))

        def along(values: np.ndarray) -> np.ndarray:
            columns = values.reshape(len(values), -1).T
            return np.stack([np.interp(station, self.station, c) for c in columns], axis=-1).reshape(
                len(station), *values.shape[1:]
            )

        tangent = along(self.tangent)
        return dataclasses.replace(
            self,
            station=station - start,
            centre=along(self.centre),
            tangent=tangent / np.linalg.norm(tangent, axis=1, keepdims=True),
            elevation=along(self.elevation),
            half_width=along(self.half_width),
            linings={
                name: Lining(
                    _cut(lining.left, start, end), _cut(lining.right, start, end), self._furniture(lining, start, end)
                )
                for name, lining in self.linings.items()
            },
        )

    def _furniture(self, lining: Lining, start: float, end: float) -> np.ndarray:
        """Furniture whose middle lies between two stations."""
        middle = 0.5 * (lining.furniture[:, :2] + lining.furniture[:, 2:])
        nearest = np.array([np.argmin(np.sum((self.centre - m) ** 2, axis=1)) for m in middle], dtype=int)
        station = self.station[nearest]
        return lining.furniture[(station >= start) & (station <= end)]


def _cut(wall: Wall, start: float, end: float) -> Wall:
    """The part of a wall between two stations, with new vertices where it is cut."""
    keep = (wall.station > start) & (wall.station < end)
    # A cut through the end of a wall must not invent a vertex beyond it.
    ends = np.clip([start, end], wall.station[0], wall.station[-1])
    cut = np.stack([np.interp(ends, wall.station, wall.vertex[:, i]) for i in range(2)], axis=-1)
    return Wall(
        vertex=np.concatenate([cut[:1], wall.vertex[keep], cut[1:]]),
        station=np.concatenate([ends[:1], wall.station[keep], ends[1:]]) - start,
    )


class _Fields:
    """Checked access to the fields of one tunnel file; every complaint names the file and the field."""

    def __init__(self, path: Path):
        self.path = path
        try:
            with np.load(path, allow_pickle=False) as data:
                self.data = {name: data[name] for name in data.files}
        except FileNotFoundError as error:
            raise TunnelError(f"{path}: no such tunnel file") from error
        except Exception as error:  # zipfile, zlib and NumPy each raise their own for a spoiled archive
            raise TunnelError(f"{path}: not a readable .npz archive ({error})") from error

    def fail(self, field: str, problem: str) -> TunnelError:
        return TunnelError(f"{self.path}: field '{field}' {problem}")

    def text(self, field: str) -> str:
        if field not in self.data:
            raise self.fail(field, "is missing")
        if self.data[field].shape != () or self.data[field].dtype.kind != "U":
            raise self.fail(field, f"must be one string, is {self.data[field].dtype} of shape {self.data[field].shape}")
        return str(self.data[field])

    def numbers(self, field: str, *shape: int | None) -> np.ndarray:
        """A finite float64 array of the given shape; None stands for any size."""
        if field not in self.data:
            raise self.fail(field, "is missing")
        value = self.data[field]
        if value.dtype.kind not in "fiu":
            raise self.fail(field, f"must hold numbers, holds {value.dtype}")
        if value.ndim != len(shape) or any(w is not None and w != h for w, h in zip(shape, value.shape, strict=True)):
            wanted = ", ".join("any" if w is None else str(w) for w in shape)
            raise self.fail(field, f"must have shape ({wanted}), has {value.shape}")
        if not np.all(np.isfinite(value)):
            where = np.argwhere(~np.isfinite(value))[0].tolist()
            raise self.fail(field, f"has a value that is not finite, at index {where}")
        return value.astype(np.float64)

    def wall(self, side: str, lining: str) -> Wall:
        field = f"{side}_{lining}"
        vertex = self.numbers(field, None, 2)
        if len(vertex) < 2:
            raise self.fail(field, f"needs at least 2 vertices, has {len(vertex)}")
        station = self.numbers(f"{side}_station_{lining}", len(vertex))
        if np.any(np.diff(station) < 0.0):
            raise self.fail(f"{side}_station_{lining}", f"decreases at index {np.argmax(np.diff(station) < 0.0)}")
        return Wall(vertex, station)


def tunnel_file(path: str | Path | None) -> Traversable:
    """The file that a path, the name of a packaged tunnel, or None (the default one) stands for."""
    name = PACKAGED[0] if path is None else str(path)
    return resources.files("subterra_jax") / "data" / f"{name}.npz" if name in PACKAGED else Path(name)


def load_tunnel(path: str | Path | None = None) -> TunnelPlan:
    """Read and check a `tunnel.npz`, or make a tunnel that goes by a name.

    Args:
        path: The file; the name of a packaged tunnel (`subterra-351`, `metro-asbuilt`); `control`, the bore without
            landmarks; or `procedural:SPLIT:INDEX`, one of the family. None is the first packaged one.

    Returns:
        The tunnel with every lining variant; `Tunnel.from_plan` makes it ready for the device.

    Raises:
        TunnelError: The file cannot be read, or a field is missing or wrong; the message names both. Or there is no
            such generated tunnel.
    """
    if GENERATED.fullmatch(str(path)):
        from subterra_jax.procedural import named  # it makes what this module defines

        return named(str(path))
    with resources.as_file(tunnel_file(path)) as file:
        return _read(file)


def tunnel_digest(path: str | Path | None = None) -> str:
    """SHA-256 of what `load_tunnel` would load: of the file, or of a generated tunnel's arrays."""
    if not GENERATED.fullmatch(str(path)):
        return hashlib.sha256(tunnel_file(path).read_bytes()).hexdigest()
    plan = load_tunnel(path)
    arrays = [plan.station, plan.centre, plan.tangent, plan.elevation, plan.half_width]
    for name, lining in plan.linings.items():
        arrays.append(np.frombuffer(name.encode(), np.uint8))
        for wall in (lining.left, lining.right):
            arrays += [wall.vertex, wall.station]
        arrays.append(lining.furniture)
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def _read(path: Path) -> TunnelPlan:
    fields = _Fields(path)
    if fields.text("schema") != SCHEMA:
        raise fields.fail("schema", f"must be {SCHEMA!r}, is {fields.text('schema')!r}")
    station = fields.numbers("station", None)
    n = len(station)
    if n < 2:
        raise fields.fail("station", f"needs at least 2 values, has {n}")
    step = np.diff(station)
    if station[0] != 0.0 or np.any(step <= 0.0) or np.any(np.abs(step - step.mean()) > 1e-6 * station[-1]):
        raise fields.fail("station", "must be a uniform, growing grid that starts at 0")
    tangent = fields.numbers("tangent", n, 2)
    if np.any(np.abs(np.linalg.norm(tangent, axis=1) - 1.0) > 1e-3):
        raise fields.fail("tangent", "must hold unit vectors")
    half_width = fields.numbers("half_width", n)
    if np.any(half_width <= 0.0):
        raise fields.fail("half_width", "must be positive")
    # Files written before the field was thought of do not have it.
    ring_pitch = float(fields.numbers("ring_pitch")) if "ring_pitch" in fields.data else 0.0
    if ring_pitch < 0.0:
        raise fields.fail("ring_pitch", f"must not be negative, is {ring_pitch}")
    names: Any = fields.data.get("lining")
    if names is None:
        raise fields.fail("lining", "is missing")
    if names.ndim != 1 or names.dtype.kind != "U" or len(names) == 0:
        raise fields.fail("lining", f"must be a list of names, is {names.dtype} of shape {names.shape}")
    return TunnelPlan(
        name=fields.text("name"),
        provenance=fields.text("provenance"),
        station=station,
        centre=fields.numbers("centre", n, 2),
        tangent=tangent,
        elevation=fields.numbers("elevation", n),
        half_width=half_width,
        lidar_height=float(fields.numbers("lidar_height")),
        linings={
            str(name): Lining(
                fields.wall("left", name), fields.wall("right", name), fields.numbers(f"furniture_{name}", None, 4)
            )
            for name in names
        },
        ring_pitch=ring_pitch,
    )
