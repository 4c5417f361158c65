"""Tunnels as files: a plan with its shell as a `tunnel.npz`, which `load_tunnel` and `scene.survey` read."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.files import replace_file
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.shell import Shell

_UNIT = 1e-4  # of a radius, m: half of it is the largest error


def save_tunnel(plan: TunnelPlan, path: str | Path) -> None:
    """Write a tunnel as `tunnel.npz`, schema 2; docs/formats.md says what each field means.

    Stations become those of the shell.

    Args:
        plan: A whole tunnel with its shell, as `load_tunnel(name, solid=True)` gives it.
        path: File to write.

    Raises:
        TunnelError: The tunnel has no shell, or is a piece of one.
    """
    shell = plan.shell
    if shell is None:
        raise TunnelError(f"tunnel {plan.name!r} has no shell to save; st.load_tunnel(name, solid=True) gives one")
    if shell.window[0] > 0.0 or shell.window[1] < shell.station[-1]:
        raise TunnelError(f"tunnel {plan.name!r} is a piece of a tunnel; save the whole")
    plan = _on_stations_of(plan, shell)
    fields: dict[str, np.ndarray] = {
        "schema": np.array("subterra.tunnel/2"),
        "name": np.array(plan.name),
        "provenance": np.array(plan.provenance),
        "station": plan.station,
        "centre": plan.centre,
        "tangent": plan.tangent,
        "elevation": plan.elevation,
        "half_width": plan.half_width,
        "lidar_height": np.array(plan.lidar_height),
        "ring_pitch": np.array(plan.ring_pitch),
        "ring_joint": plan.ring_joint,
        "lining": np.array(list(plan.linings)),
        "shell_height": shell.position[:, 2] - plan.elevation,
        "shell_rise": shell.tangent[:, 2],
        "shell_angle": shell.angle,
        "shell_section": shell.section,
        "shell_unit": np.array(_UNIT),
        "shell_radius": _encode(shell.radius),
        "shell_track": shell.track.astype(np.float32),
        "shell_spacing": np.array(shell.spacing),
    }
    for name, lining in plan.linings.items():
        for side, wall in (("left", lining.left), ("right", lining.right)):
            fields[f"{side}_{name}"], fields[f"{side}_station_{name}"] = wall.vertex, wall.station
        own = shell.linings[name]
        fields[f"furniture_{name}"] = lining.furniture
        fields[f"shell_pocket_{name}"], fields[f"shell_seam_{name}"] = own.pocket, np.array(own.seam)
        fields[f"shell_brick_{name}"] = own.brick.astype(np.float32)
        if own.radius is not None:
            fields[f"shell_radius_{name}"] = _encode(own.radius)
    with replace_file(Path(path)) as part, part.open("wb") as file:
        np.savez_compressed(file, **fields)  # type: ignore[arg-type]


def _on_stations_of(plan: TunnelPlan, shell: Shell) -> TunnelPlan:
    """Return a plan at the stations of its shell, with its centreline under the shell's axis."""
    level = np.hypot(shell.tangent[:, 0], shell.tangent[:, 1])[:, None]

    def along(values: np.ndarray) -> np.ndarray:
        return np.interp(shell.station, plan.station, values)

    return dataclasses.replace(
        plan,
        station=shell.station,
        centre=shell.position[:, :2],
        tangent=shell.tangent[:, :2] / level,
        elevation=along(plan.elevation),
        half_width=along(plan.half_width),
    )


def _encode(radius: Float[np.ndarray, "n m"]) -> Int[np.ndarray, "n m"]:
    """Return whole units as differences along and around, which are small and pack well."""
    units = np.rint(radius / _UNIT).astype(np.int64)
    return np.diff(np.diff(units, axis=0, prepend=0), axis=1, prepend=0).astype(np.int32)
