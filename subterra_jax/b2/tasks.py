"""The walking task by its id: an environment and its params."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.gait import GaitParams
from subterra_jax.b2.ids import WALK
from subterra_jax.b2.model import RobotError
from subterra_jax.b2.params import CommandParams, SensorParams, VarietyParams, WalkParams, WalkRewardParams
from subterra_jax.b2.physics import Physics
from subterra_jax.b2.track import Track, by_standard, from_scene
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel

_ROOM = 0.1  # to either side of the robot's envelope, m


def make(
    id: str = WALK,
    tunnel: TunnelPlan | str | Path | None = None,
    lining: str | None = None,
    *,
    scene: str | Path | None = None,
    physics: Physics | None = None,
    driven: bool = False,
    privileged: bool = False,
    **overrides: Any,
) -> tuple[WalkEnv, WalkParams]:
    """Make the walking environment and its params.

    Args:
        id: `Subterra/B2Walk-v0`.
        tunnel: A tunnel file, a name as for `load_tunnel`, or a plan; None is the packaged tunnel. Sleepers are laid
            by standard.
        lining: Variant of the walls; None is `pockets`, or the first where a tunnel has none.
        scene: A built scene folder, whose tunnel and sleepers are taken; instead of `tunnel`.
        physics: The robot and its window of track; the defaults if left out.
        driven: As for `WalkEnv`.
        privileged: As for `WalkEnv`.
        **overrides: Fields of `WalkParams` to replace.

    Raises:
        ValueError: No such task or field, or both a tunnel and a scene.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
        TrackError: The scene has no track.
        RobotError: The tunnel is narrower than the robot.
    """
    if id != WALK:
        raise ValueError(f"no walking task {id!r}; there is {WALK}")
    if scene is not None and tunnel is not None:
        raise ValueError(f"either a tunnel or a scene, got both {str(tunnel)!r} and {str(scene)!r}")
    plan, track = _place(tunnel, scene)
    check_room(plan)
    known = {field.name for field in dataclasses.fields(WalkParams)} - {"tunnel", "track"}
    if unknown := set(overrides) - known:
        raise ValueError(f"no field {sorted(unknown)} in WalkParams; there are {sorted(known)}")
    fields = {
        "gait": GaitParams(),
        "command": CommandParams(),
        "variety": VarietyParams(),
        "sensor": SensorParams(),
        "reward": WalkRewardParams(),
        **overrides,
    }
    params = WalkParams(tunnel=Tunnel.from_plan(plan, lining), track=track, **fields)
    env = WalkEnv(id=id, physics=physics or Physics(), driven=driven, privileged=privileged)
    return env, as_arrays(params)


def as_arrays(params: Any) -> Any:
    """Params whose every leaf is a 32-bit array; tuples of numbers become one array."""

    def array(leaf: Any) -> jax.Array:
        leaf = jnp.asarray(leaf)
        return leaf.astype(jnp.int32 if jnp.issubdtype(leaf.dtype, jnp.integer) else jnp.float32)

    return jax.tree.map(array, params, is_leaf=lambda leaf: isinstance(leaf, tuple))


def check_room(plan: TunnelPlan) -> None:
    """Raises `RobotError` where a tunnel is narrower than the robot with 0.1 m to either side."""
    needed, narrowest = b2.ENVELOPE[1] + 2.0 * _ROOM, int(np.argmin(plan.half_width))
    if (width := 2.0 * float(plan.half_width[narrowest])) < needed:
        raise RobotError(
            f"tunnel {plan.name!r} is {width:.2f} m wide at {plan.station[narrowest]:.1f} m; "
            f"the B2 needs {needed:.2f} m"
        )


def _place(tunnel: TunnelPlan | str | Path | None, scene: str | Path | None) -> tuple[TunnelPlan, Track]:
    if scene is not None:
        plan = load_tunnel(Path(scene) / "tunnel.npz")
        return plan, from_scene(Path(scene), plan)
    plan = tunnel if isinstance(tunnel, TunnelPlan) else load_tunnel(tunnel)
    return plan, by_standard(plan)
