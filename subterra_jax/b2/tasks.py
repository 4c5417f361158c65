"""The tasks of the B2 by id: the walking task and the missions on a learnt gait, each as environment and params."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from subterra_jax.b2.gait import RELEASED, WalkPolicy, check_fits, make_policy
from subterra_jax.b2.mission import PERIODS, Legs
from subterra_jax.b2.model import B2
from subterra_jax.b2.params import RandomisationParams, WalkParams
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.parts.odometer import OdometryParams
from subterra_jax.parts.unicycle import VehicleParams
from subterra_jax.physics.stage import ENGINES, EngineName, Stage, settle
from subterra_jax.policies.files import read
from subterra_jax.rules import StartParams
from subterra_jax.state import as_arrays
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel
from subterra_jax.tunnel_env import TunnelEnv

TROT = "trot"  # the scripted gait, without a trained policy

# Five commands a second, within the velocities for which the gait was trained.
VEHICLE = VehicleParams(speed_max=0.8, yaw_rate_max=0.8, radius=0.4, period=0.2)
# All four feet on the track, between the rails, at no larger angle than the robot reaches by itself.
START = StartParams(station=2.0, lateral=0.3, heading=0.1)
HORIZON = 4000
_ENTRIES = {
    "vehicle": VEHICLE,
    "odometry": OdometryParams(distance_sigma=0.0, distance_bias_sigma=0.0, heading_sigma=0.0),
    "start": START,
}


def make(
    tunnel: TunnelPlan | str | Path | None = None,
    lining: str | None = None,
    *,
    scene: str | Path | None = None,
    engine: EngineName = "mjx",
    driven: bool = False,
    privileged: bool = False,
    **overrides: Any,
) -> tuple[WalkEnv, WalkParams]:
    """Makes the walking environment and its params.

    Args:
        tunnel: A tunnel file, a name as for `load_tunnel`, or a plan; None is the packaged tunnel. The robot walks on
            its sleepers as measured, or on its floor where it has none.
        lining: Variant of the walls; None is `pockets`, or the first where a tunnel has none.
        scene: A built scene folder, whose tunnel is taken; instead of `tunnel`.
        engine: As for `physics.stage.settle`.
        driven: As for `WalkEnv`.
        privileged: As for `WalkEnv`.
        **overrides: Fields of `WalkParams` to replace.

    Raises:
        ValueError: No such field, or both a tunnel and a scene.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
        SubterraError: As `physics.stage.settle`.
    """
    plan = _load(tunnel, scene)
    return _walker(settle(B2, [plan], lining, scene, engine), plan, lining, overrides, driven, privileged)


def _walker(
    stage: Stage, plan: TunnelPlan, lining: str | None, fields: dict[str, Any], driven: bool, privileged: bool = False
) -> tuple[WalkEnv, WalkParams]:
    known = {field.name for field in dataclasses.fields(WalkParams)} - {"tunnel", "track"}
    if unknown := set(fields) - known:
        raise ValueError(f"no field {sorted(unknown)} in WalkParams; there are {sorted(known)}")
    params = WalkParams(tunnel=Tunnel.from_plan(plan, lining), track=stage.track, **fields)
    env = WalkEnv(physics=stage.engine, driven=driven, privileged=privileged)
    return env, as_arrays(params)


def _load(tunnel: TunnelPlan | str | Path | None, scene: str | Path | None) -> TunnelPlan:
    if scene is not None and tunnel is not None:
        raise ValueError(f"either a tunnel or a scene, got both {str(tunnel)!r} and {str(scene)!r}")
    if scene is not None:
        return load_tunnel(Path(scene) / "tunnel.npz")
    return tunnel if isinstance(tunnel, TunnelPlan) else load_tunnel(tunnel)


def on_legs(
    env: TunnelEnv, tunnel: Any, lining: str | None, overrides: Mapping[str, Any]
) -> tuple[TunnelEnv, dict[str, Any]]:
    """Return a planar task on the legs of the B2, and its entries of `EnvParams`.

    Args:
        env: The task on wheels.
        tunnel: As for `make`.
        lining: As for `make`.
        overrides: Entries in place of the defaults; `engine` and `scene`, as for `physics.rolling.on_rover`; `policy`,
            the gait: a policy, its file or name, or `trot`; and `walk`, fields of `WalkParams` to replace.

    Raises:
        ValueError: No such engine or field, or a LiDAR that sweeps.
        SubterraError: As `physics.stage.settle`.
        PolicyError: There is no such gait, or it does not fit the robot.
    """
    asked = dict(overrides)
    engine, scene = asked.pop("engine", ENGINES[0]), asked.pop("scene", None)
    policy, fields = asked.pop("policy", RELEASED), asked.pop("walk", {})
    if getattr(asked.get("lidar"), "sweep", False):
        raise ValueError("sweep=True does not go with a robot on legs: it knows its trunk at the end of a step alone")
    plan = _load(tunnel, None)
    stage = settle(B2, [plan], lining, scene, engine)
    # No pushes on the way.
    own_walk = {"randomisation": RandomisationParams(push=0.0), **fields}
    walker, walking = _walker(stage, plan, lining, own_walk, driven=True)
    own = {"walk": walking, "policy": _gait(policy, walker.observation_size(walking))}
    env, entries = stage.mount(env, Legs(walk=walker), {**_ENTRIES, **asked, **own}, "start" in asked)
    period, commanded = float(jnp.asarray(entries["vehicle"].period)), PERIODS * walker.physics.period
    if abs(period - commanded) > 1e-6:
        raise ValueError(f"the B2 takes a command every {commanded:g} s, got period={period:g}")
    return env, entries


def _gait(policy: WalkPolicy | str | Path, size: int) -> WalkPolicy | None:
    if policy == TROT:
        return None
    source = policy.name if isinstance(policy, WalkPolicy) else policy
    trained = policy if isinstance(policy, WalkPolicy) else make_policy(read(policy))
    check_fits(trained, size, source)
    return trained
