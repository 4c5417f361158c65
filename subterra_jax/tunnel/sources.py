"""Tunnels by name: packaged ones, files and generated ones."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import os
import pickle
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.files import cache_folder, make_writable, replace_file
from subterra_jax.host.texture import texture_seed
from subterra_jax.procedural import GENERATED, default_lining, expand, generate
from subterra_jax.procedural import NAME as CONTROL
from subterra_jax.procedural.open_world import in_benchmark
from subterra_jax.tunnel.file import read_tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.tunnel import Tunnel, stack


def named(tunnel: str | Path | None, scene: Path | None) -> str | Path | None:
    """Return the tunnel that is named, or that of a scene's folder or MJCF file; `None` where neither is.

    Raises:
        TunnelError: Both are named, or there is no such scene.
    """
    if scene is None:
        return tunnel
    if tunnel is not None:
        raise TunnelError("either --scene or --tunnel, not both: a scene brings its own tunnel")
    if not scene.exists():
        raise TunnelError(f"{scene}: no such scene folder")
    return (scene if scene.is_dir() else scene.parent) / "tunnel.npz"


_MOST = 2_000_000_000  # bytes of tunnels kept on disk; of more, those not used for longest go
_MADE_BY = ("procedural", "tunnel", "lidar3d")  # packages whose code a tunnel's arrays depend on
PACKAGED = ("subterra-351", "metro")  # the first is the default

Source = Tunnel | TunnelPlan | str | Path | None


def tunnel_file(path: str | Path | None) -> Traversable:
    """Return the file for a path, which may be a scene's folder, for a packaged tunnel's name, or for `None`."""
    name = PACKAGED[0] if path is None else str(path)
    if name in PACKAGED:
        return resources.files("subterra_jax") / "data" / f"{name}.npz"
    inside = Path(name) / "tunnel.npz"
    return inside if inside.is_file() else Path(name)


def load_tunnel(path: str | Path | None = None, *, solid: bool = False) -> TunnelPlan:
    """Read and check a `tunnel.npz`, or generate a tunnel by its name.

    Args:
        path: The file, or the scene folder that holds it; the name of a packaged tunnel (`subterra-351`, `metro`);
            `control`, the bore without landmarks; `open:SPLIT:INDEX` or `open:KIND:SPLIT:INDEX` of the open world.
            `None`: the first packaged.
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
        if not file.exists() and Path(str(path)).parent == Path() and not Path(str(path)).suffix:
            by_name = f"{', '.join(PACKAGED)}, control, open:SPLIT:INDEX and open:KIND:SPLIT:INDEX"
            raise TunnelError(f"{path}: no such tunnel file; by name there are {by_name}")
        plan = read_tunnel(file)
    return dataclasses.replace(plan, texture=texture_seed(plan.name)) if path is None or str(path) in PACKAGED else plan


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
    stretch: tuple[float, float] | None,
    reach: float,
    spatial: bool = False,
) -> Tunnel:
    """Return the device tunnel for anything that a user may name one by.

    Args:
        tunnel: A `Tunnel`, which is returned unchanged; a plan; a file or name, as for `load_tunnel`; `None` for the
            packaged tunnel; or a list of these, which becomes one stack, as does a name like `open:train:0-255`.
        lining: Variant of the walls; `None` is `pockets`, or the first where a tunnel has none.
        stretch: Start and length of the stretch to cut out, m; `None` keeps the whole tunnel. A stretch beyond the end
            is shortened.
        reach: Largest range of a planar LiDAR, m.
        spatial: Add the tunnel's `Space`, which a LiDAR in three dimensions needs.

    Raises:
        TunnelError: A file cannot be read, is wrong or holds no heights, or the tunnel or lining does not exist.
        ValueError: A `Tunnel` was made for shorter ranges or for planar LiDARs alone, or the list is empty.
    """
    if isinstance(tunnel, Tunnel):
        return _single(tunnel, lining, stretch, reach, spatial)
    sources = list_sources(tunnel)
    if not spatial and all(isinstance(each, str) and _is_ours(each) for each in sources):
        return jax.device_put(_named(tuple(sources), lining, stretch, reach))
    return _joined(sources, lining, stretch, reach, spatial)


def list_sources(tunnel: TunnelPlan | str | Path | Sequence[Source] | None) -> list[Source]:
    """Return each of what a user may name tunnels by; arguments as for `resolve`."""
    if tunnel is None:
        return [PACKAGED[0]]
    if isinstance(tunnel, str | Path):
        return [*expand(str(tunnel))]
    if isinstance(tunnel, TunnelPlan):
        return [tunnel]
    if not isinstance(tunnel, Iterable):
        raise ValueError(f"a tunnel is a name, a file, a plan, a Tunnel or a list of these, got {tunnel!r}")
    return list(tunnel)


def _is_ours(name: str) -> bool:
    """Tell whether a name always means the same tunnel."""
    return name in PACKAGED or name == CONTROL or in_benchmark(name)


@functools.lru_cache(maxsize=8)
def _named(names: tuple[str, ...], lining: str | None, stretch: tuple[float, float] | None, reach: float) -> Tunnel:
    """Return tunnels by name, on the host: a process makes a task many times, and may give away what it got."""
    return jax.device_get(_joined(names, lining, stretch, reach, False))


def _joined(
    sources: Sequence[Source], lining: str | None, stretch: tuple[float, float] | None, reach: float, spatial: bool
) -> Tunnel:
    """Return one tunnel, or the stack of several; arguments as for `resolve`."""
    one = functools.partial(_single, lining=lining, stretch=stretch, reach=reach, spatial=spatial)
    if not all(isinstance(each, str) and in_benchmark(each) for each in sources):
        return stack([one(each) for each in sources])
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:  # most of the work is NumPy's
        return stack(list(pool.map(one, sources)))


def _single(
    tunnel: Source, lining: str | None, stretch: tuple[float, float] | None, reach: float, spatial: bool
) -> Tunnel:
    """Return the device tunnel of one source; arguments as for `resolve`."""
    if isinstance(tunnel, Tunnel):
        if tunnel.reach < reach:
            raise ValueError(f"the tunnel was made for ranges up to {tunnel.reach} m, got range_max={reach}")
        if spatial and tunnel.space is None:
            raise ValueError("the tunnel was made for planar LiDARs alone: give its name, its file or its plan")
        return tunnel
    if isinstance(tunnel, TunnelPlan):
        return _put(tunnel, lining, stretch, reach, spatial)
    if not GENERATED.fullmatch(str(tunnel)):
        put = lambda: _put(load_tunnel(tunnel), lining, stretch, reach, spatial)  # noqa: E731
        file = Path(str(tunnel_file(tunnel)))  # a surface takes a quarter of a minute
        return _kept(put, tunnel_digest(tunnel), lining, stretch, reach) if spatial and file.is_file() else put()
    # No more than is needed is made.
    name, lining = str(tunnel), lining or default_lining(str(tunnel))
    make = lambda: _put(generate(name, (lining,), spatial), lining, stretch, reach, spatial)  # noqa: E731
    return _kept(make, name, lining, stretch, reach, spatial) if in_benchmark(name) else make()


def _put(
    plan: TunnelPlan, lining: str | None, stretch: tuple[float, float] | None, reach: float, spatial: bool
) -> Tunnel:
    """Put a plan on the device; arguments as for `resolve`."""
    if stretch is not None:
        name = lining or plan.default_lining
        # No more than is needed is cut.
        plan = dataclasses.replace(plan, linings={name: plan.lining(name)}).stretch(stretch)
    planar = Tunnel.from_plan(plan, lining, reach=reach)
    if not spatial:
        return planar
    from subterra_jax.lidar3d.space import Space  # it reads plans itself

    return dataclasses.replace(planar, space=Space.from_plan(plan, lining))


def _kept(make: Callable[[], Tunnel], *content: Any) -> Tunnel:
    """Return a tunnel from the cache, or make it and keep it there; where no folder can be written, just make it.

    Args:
        make: Makes the tunnel.
        *content: All that the tunnel depends on beside the code: its name, lining, stretch.
    """
    folder = cache_folder("tunnels")
    if not make_writable(folder):
        return make()
    file = folder / f"{hashlib.sha256(repr((_code(), *content)).encode()).hexdigest()[:40]}.pickle"
    with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):
        content_bytes = file.read_bytes()
        file.touch()  # it was used
        return jax.device_put(pickle.loads(content_bytes))
    made = make()
    with contextlib.suppress(OSError):
        with replace_file(file) as fresh:
            fresh.write_bytes(pickle.dumps(jax.device_get(made)))
        _shrink(folder)
    return made


@functools.cache
def _code() -> str:
    """Return a digest of the code that makes tunnels and of the library that it computes with."""
    root = Path(__file__).parents[1]
    files = [file for name in _MADE_BY for file in sorted((root / name).glob("*.py"))]
    sources = b"".join(file.read_bytes() for file in files)
    return hashlib.sha256(sources + np.__version__.encode()).hexdigest()


def _shrink(folder: Path) -> None:
    """Remove the tunnels that were not used for longest until no more than `_MOST` bytes are left."""
    kept = sorted(((file.stat(), file) for file in folder.glob("*.pickle")), key=lambda one: -one[0].st_mtime)
    total = 0
    for facts, file in kept:
        total += facts.st_size
        if total > _MOST:
            file.unlink(missing_ok=True)
