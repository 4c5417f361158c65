"""Tunnels by name: packaged ones, files and generated ones. A complaint about a file names the file and the field."""

import concurrent.futures
import dataclasses
import functools
import hashlib
import os
import zipfile
from collections.abc import Iterable, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.versions import BUILD_AGAIN, other_schema
from subterra_jax.procedural import GENERATED, default_lining, expand, generate
from subterra_jax.procedural.open_world import in_benchmark
from subterra_jax.tunnel.kept import keep
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall
from subterra_jax.tunnel.shell import N_BRICK, SPACING, Shell, ShellLining
from subterra_jax.tunnel.tunnel import Tunnel, stack

SCHEMA, PLANAR_SCHEMA = "subterra.tunnel/2", "subterra.tunnel/1"  # with the bore in three dimensions, and without


def describe_damage(path: Path, error: Exception) -> str:
    """Say why an archive cannot be read; NumPy's own message takes every other file for a pickle."""
    if path.is_dir():
        return "it is a folder"
    return str(error) if path.stat().st_size and zipfile.is_zipfile(path) else "it is no zip file, or is cut short"


class _Fields:
    """Checked access to the fields of one tunnel file."""

    def __init__(self, path: Path):
        self.path = path
        try:
            with np.load(path, allow_pickle=False) as data:
                self.data = {name: data[name] for name in data.files}
        except FileNotFoundError as error:
            by_name = f"; by name there are {', '.join(PACKAGED)}, control, open:SPLIT:INDEX and open:KIND:SPLIT:INDEX"
            a_name = path.parent == Path() and not path.suffix
            raise TunnelError(f"{path}: no such tunnel file{by_name if a_name else ''}") from error
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


def read_tunnel(path: Path) -> TunnelPlan:
    """Read and check a `tunnel.npz`.

    Raises:
        TunnelError: The file cannot be read, or a field is missing or wrong.
    """
    fields = _Fields(path)
    if (schema := fields.text("schema")) not in (SCHEMA, PLANAR_SCHEMA):
        raise TunnelError(f"{path}: {other_schema(schema, SCHEMA, BUILD_AGAIN)}")
    axis = _read_axis(fields)
    # Older files do not have the field.
    ring_pitch = float(fields.numbers("ring_pitch")) if "ring_pitch" in fields.data else 0.0
    if ring_pitch < 0.0:
        raise fields.fail("ring_pitch", f"must not be negative, is {ring_pitch}")
    linings = _read_linings(fields)
    plan = TunnelPlan(
        name=fields.text("name"),
        provenance=fields.text("provenance"),
        **axis,
        lidar_height=float(fields.numbers("lidar_height")),
        linings=linings,
        ring_pitch=ring_pitch,
        ring_joint=fields.numbers("ring_joint", None) if "ring_joint" in fields.data else np.zeros(0),
        source=str(path),
    )
    if schema == SCHEMA:
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
    if np.any(np.abs(np.linalg.norm(tangent, axis=1) - 1.0) > 1e-3):
        raise fields.fail("tangent", "must hold unit vectors")
    against = np.sum(np.gradient(centre, axis=0) * tangent, axis=1) <= 0.0
    if np.any(against):
        raise fields.fail("tangent", f"is flipped at index {np.argmax(against)}: it points against the centreline")
    half_width = fields.numbers("half_width", n)
    if np.any(half_width <= 0.0):
        raise fields.fail("half_width", "must be positive")
    elevation = fields.numbers("elevation", n)
    return {
        "station": station,
        "centre": centre,
        "tangent": tangent,
        "elevation": elevation,
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


def _read_shell(fields: _Fields, plan: TunnelPlan) -> Shell:
    """Read the bore in three dimensions."""
    n = len(plan.station)
    angle, rise = fields.numbers("shell_angle", None), fields.numbers("shell_rise", n)
    m = len(angle)
    step = np.diff(angle, append=angle[:1] + 2 * np.pi) if m else np.zeros(1)
    if m < 8 or np.any(np.abs(step - 2 * np.pi / m) > 1e-6):
        raise fields.fail("shell_angle", "must hold at least 8 even directions over one turn")
    if np.any(np.abs(rise) >= 1.0):
        raise fields.fail("shell_rise", "must be above -1 and below 1")
    unit = float(fields.numbers("shell_unit"))

    def decode(field: str) -> np.ndarray:
        values = unit * fields.numbers(field, n, m).cumsum(axis=1).cumsum(axis=0)
        if not np.all(values > 0.0):
            raise fields.fail(field, "must give positive distances from the axis")
        return np.asarray(values)

    radius = decode("shell_radius")
    section = fields.numbers("shell_section", m)
    if not np.all(section > 0.0):
        raise fields.fail("shell_section", "must give positive distances from the axis")
    level = np.sqrt(1.0 - rise**2)[:, None]
    spacing = _read_spacing(fields)
    return Shell(
        station=plan.station,
        position=np.column_stack([plan.centre, plan.elevation + fields.numbers("shell_height", n)]),
        tangent=np.column_stack([level * plan.tangent, rise]),
        angle=angle,
        radius=radius,
        section=section,
        track=fields.numbers("shell_track", None, N_BRICK),
        linings={
            name: ShellLining(
                fields.numbers(f"shell_pocket_{name}", None, 5),
                fields.numbers(f"shell_brick_{name}", None, N_BRICK),
                float(fields.numbers(f"shell_seam_{name}")),
                decode(f"shell_radius_{name}") if f"shell_radius_{name}" in fields.data else None,
            )
            for name in plan.linings
        },
        spacing=spacing,
    )


def _read_spacing(fields: _Fields) -> tuple[float, float]:
    """Read the spacing of the shell's vertices, m; files of scenes do not have the field."""
    if "shell_spacing" not in fields.data:
        return SPACING
    along, around = fields.numbers("shell_spacing", 2).tolist()
    if min(along, around) <= 0.0:
        raise fields.fail("shell_spacing", "must be positive")
    return along, around


def _lateral(plan: TunnelPlan, wall: Wall) -> np.ndarray:
    """Return the distances of a wall's vertices to the left of the centreline, m."""
    x, y, tangent_x, tangent_y = (
        np.interp(wall.station, plan.station, column) for column in (*plan.centre.T, *plan.tangent.T)
    )
    return tangent_x * (wall.vertex[:, 1] - y) - tangent_y * (wall.vertex[:, 0] - x)


def tunnel_of(scene: Path) -> Path:
    """Return the tunnel file of a scene folder, or the one beside an MJCF file."""
    return (scene if scene.is_dir() else scene.parent) / "tunnel.npz"


PACKAGED = ("subterra-351", "metro-asbuilt", "metro-universal", "subterra-universal")  # the first is the default
# The walls of packaged tunnels stay, byte for byte, since every score depends on them. The bore in three dimensions of
# the first two lies beside them, from the same survey built again; that of the others is in the same file.
SOLID = "-solid.npz"

Source = Tunnel | TunnelPlan | str | Path | None


def tunnel_file(path: str | Path | None) -> Traversable:
    """Return the file for a path, for the name of a packaged tunnel, or for `None`, the default one."""
    name = PACKAGED[0] if path is None else str(path)
    return resources.files("subterra_jax") / "data" / f"{name}.npz" if name in PACKAGED else Path(name)


def load_tunnel(path: str | Path | None = None, *, solid: bool = False) -> TunnelPlan:
    """Read and check a `tunnel.npz`, or generate a tunnel by its name.

    Args:
        path: The file; the name of a packaged tunnel (`subterra-351`, `metro-asbuilt`, `metro-universal`,
            `subterra-universal`); `control`, the bore without landmarks; `open:SPLIT:INDEX` or
            `open:KIND:SPLIT:INDEX`, one of the open world, after `FILE.py:` where a user's file registers
            the kind. `None` is the first packaged one.
        solid: Give a tunnel of the open world its shell too, the bore in three dimensions; a file that has one always
            comes with it.

    Returns:
        The tunnel with every lining variant; `Tunnel.from_plan` puts it on the device.

    Raises:
        TunnelError: The file cannot be read, or a field is missing or wrong; the message names both. Or the generated
            tunnel does not exist.
    """
    if GENERATED.fullmatch(str(path)):
        return generate(str(path), solid=solid)
    with resources.as_file(tunnel_file(path)) as file:
        plan = read_tunnel(file)
    beside = resources.files("subterra_jax") / "data" / f"{plan.name}{SOLID}"
    if plan.shell is not None or str(path or PACKAGED[0]) not in PACKAGED or not beside.is_file():
        return plan
    with resources.as_file(beside) as file:
        return dataclasses.replace(plan, shell=read_tunnel(file).shell)


def tunnel_digest(path: str | Path | None = None) -> str:
    """Return the SHA-256 of a tunnel file, or of a generated tunnel's arrays."""
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


def resolve(
    tunnel: Source | Sequence[Source],
    lining: str | None,
    piece: tuple[float, float] | None,
    reach: float,
    spatial: bool = False,
) -> Tunnel:
    """Return the device tunnel for anything that a user may name one by.

    Args:
        tunnel: A `Tunnel`, which is returned unchanged; a plan; a file or name, as for `load_tunnel`; `None` for the
            packaged tunnel; or a list of these, which becomes one stack, as does a name like `open:train:0-255`.
        lining: Variant of the walls; `None` is `pockets`, or the first where a tunnel has none.
        piece: Start and length of the piece to cut out, m; `None` keeps the whole tunnel. A piece beyond the tunnel's
            end is shortened.
        reach: Largest range of a planar LiDAR, m.
        spatial: Add the tunnel's `Space`, which a LiDAR in three dimensions needs.

    Raises:
        TunnelError: A file cannot be read, is wrong or holds no heights, or the tunnel or lining does not exist.
        ValueError: A `Tunnel` was made for shorter ranges or for planar LiDARs alone, or the list is empty.
    """
    if isinstance(tunnel, Tunnel):
        if tunnel.reach < reach:
            raise ValueError(f"the tunnel was made for ranges up to {tunnel.reach} m, got range_max={reach}")
        if spatial and tunnel.space is None:
            raise ValueError("the tunnel was made for planar LiDARs alone: give its name, its file or its plan")
        return tunnel
    if isinstance(tunnel, str | Path) and len(names := expand(str(tunnel))) > 1:
        tunnel = names
    if tunnel is not None and not isinstance(tunnel, TunnelPlan | str | Path):
        if not isinstance(tunnel, Iterable):
            raise ValueError(f"a tunnel is a name, a file, a plan, a Tunnel or a list of these, got {tunnel!r}")
        sources = list(tunnel)
        one = functools.partial(resolve, lining=lining, piece=piece, reach=reach, spatial=spatial)
        if not all(isinstance(each, str) and in_benchmark(each) for each in sources):
            return stack([one(each) for each in sources])
        with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:  # most of the work is NumPy's
            return stack(list(pool.map(one, sources)))
    if isinstance(tunnel, TunnelPlan):
        return _put(tunnel, lining, piece, reach, spatial)
    if not GENERATED.fullmatch(str(tunnel)):
        put = lambda: _put(load_tunnel(tunnel), lining, piece, reach, spatial)  # noqa: E731
        file = Path(str(tunnel_file(tunnel)))  # a surface takes a quarter of a minute
        return keep(put, file.read_bytes(), lining, piece, reach) if spatial and file.is_file() else put()
    # No more than is needed is made.
    name, lining = str(tunnel), lining or default_lining(str(tunnel))
    make = lambda: _put(generate(name, (lining,), spatial), lining, piece, reach, spatial)  # noqa: E731
    return keep(make, name, lining, piece, reach, spatial) if in_benchmark(name) else make()


def _put(
    plan: TunnelPlan, lining: str | None, piece: tuple[float, float] | None, reach: float, spatial: bool
) -> Tunnel:
    """Put a plan on the device; arguments as for `resolve`."""
    if piece is not None:
        name = lining or plan.default_lining
        plan = dataclasses.replace(plan, linings={name: plan.lining(name)})  # no more than is needed is cut
        start, length = piece
        plan = plan.slice(start, min(length, plan.length - start))
    planar = Tunnel.from_plan(plan, lining, reach=reach)
    if not spatial:
        return planar
    from subterra_jax.lidar3d.space import Space  # it reads plans itself

    return dataclasses.replace(planar, space=Space.from_plan(plan, lining))
