"""Tunnels by name: packaged ones, files, and generated ones."""

import hashlib
import re
from collections.abc import Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np

from subterra_jax.procedural import expand, named
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.reading import read_tunnel
from subterra_jax.tunnel.stack import stack
from subterra_jax.tunnel.tunnel import Tunnel

PACKAGED = ("subterra-351", "metro-asbuilt")  # the first is the default
GENERATED = re.compile(r"control|procedural:.*")  # names of tunnels that are made, not read

Source = Tunnel | TunnelPlan | str | Path | None


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
        return named(str(path))
    with resources.as_file(tunnel_file(path)) as file:
        return read_tunnel(file)


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


def resolve(
    tunnel: Source | Sequence[Source],
    lining: str | None,
    piece: tuple[float, float] | None,
    reach: float,
) -> Tunnel:
    """A device tunnel from whatever a user names one by.

    Args:
        tunnel: A ready `Tunnel`, taken as it is; a plan; a file or a name, as for `load_tunnel`; None for the packaged
            tunnel; or a list of such things, which becomes one stack, as does a name like `procedural:train:0-255`.
        lining: The variant of the walls; None is `pockets`, or the first where a tunnel has none.
        piece: Start and length of the piece to cut out, m; None keeps the whole tunnel. A length beyond the tunnel's
            end is shortened to it.
        reach: Largest range that will be asked for, m.

    Raises:
        TunnelError: A file is unreadable or wrong, or there is no such tunnel or lining.
        ValueError: A ready tunnel was made for shorter ranges, or the list is empty.
    """
    if isinstance(tunnel, Tunnel):
        if tunnel.reach < reach:
            raise ValueError(f"the tunnel was made for ranges up to {tunnel.reach} m, got range_max={reach}")
        return tunnel
    if isinstance(tunnel, str | Path) and len(names := expand(str(tunnel))) > 1:
        tunnel = names
    if tunnel is not None and not isinstance(tunnel, TunnelPlan | str | Path):
        return stack([resolve(each, lining, piece, reach) for each in tunnel])
    plan = tunnel if isinstance(tunnel, TunnelPlan) else load_tunnel(tunnel)
    if piece is not None:
        start, length = piece
        plan = plan.slice(start, min(length, plan.length - start))
    return Tunnel.from_plan(plan, lining, reach=reach)
