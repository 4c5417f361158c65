"""The walking task by its id: an environment and its params."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.b2 import WALK
from subterra_jax.b2 import constants as b2
from subterra_jax.b2.gait import GaitParams
from subterra_jax.b2.model import RobotError
from subterra_jax.b2.params import CommandParams, RandomisationParams, SensorParams, WalkParams, WalkRewardParams
from subterra_jax.b2.physics import Physics
from subterra_jax.b2.track import Track, lay_standard_track, read_scene_track
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel

_MARGIN = 0.1  # to either side of the robot's envelope, m


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
    """Makes the walking environment and its params.

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
    plan, track = _load_track(tunnel, scene)
    check_width(plan)
    known = {field.name for field in dataclasses.fields(WalkParams)} - {"tunnel", "track"}
    if unknown := set(overrides) - known:
        raise ValueError(f"no field {sorted(unknown)} in WalkParams; there are {sorted(known)}")
    fields = {
        "gait": GaitParams(),
        "command": CommandParams(),
        "randomisation": RandomisationParams(),
        "sensor": SensorParams(),
        "reward": WalkRewardParams(),
        **overrides,
    }
    params = WalkParams(tunnel=Tunnel.from_plan(plan, lining), track=track, **fields)
    env = WalkEnv(id=id, physics=physics or Physics(), driven=driven, privileged=privileged)
    return env, as_arrays(params)


def as_arrays(params: Any) -> Any:
    """Turns every leaf of params into a 32-bit array; a tuple of numbers becomes one array."""

    def array(leaf: Any) -> jax.Array:
        leaf = jnp.asarray(leaf)
        return leaf.astype(jnp.int32 if jnp.issubdtype(leaf.dtype, jnp.integer) else jnp.float32)

    return jax.tree.map(array, params, is_leaf=lambda leaf: isinstance(leaf, tuple))


def check_width(plan: TunnelPlan) -> None:
    """Raises `RobotError` where a tunnel is narrower than the robot with 0.1 m to either side."""
    needed, narrowest = b2.ENVELOPE[1] + 2.0 * _MARGIN, int(np.argmin(plan.half_width))
    if (width := 2.0 * float(plan.half_width[narrowest])) < needed:
        raise RobotError(
            f"tunnel {plan.name!r} is {width:.2f} m wide at {plan.station[narrowest]:.1f} m; "
            f"the B2 needs {needed:.2f} m"
        )


def _load_track(tunnel: TunnelPlan | str | Path | None, scene: str | Path | None) -> tuple[TunnelPlan, Track]:
    """Tunnel and track of a scene, or of a tunnel with standard sleepers."""
    if scene is not None:
        plan = load_tunnel(Path(scene) / "tunnel.npz")
        return plan, read_scene_track(Path(scene), plan)
    plan = tunnel if isinstance(tunnel, TunnelPlan) else load_tunnel(tunnel)
    return plan, lay_standard_track(plan)
