"""A window of track that follows the robot: ballast, the four nearest sleepers and two rails as mocap bodies.

Its cost does not depend on the tunnel's length. Everything is given from the nearest sleeper, the *anchor*, whose
middle is the origin of the physics: coordinates stay small however long the tunnel is.
"""

import dataclasses

import jax.numpy as jnp
import mujoco
from jax import lax
from jaxtyping import Array, Float, Int

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import rotation
from subterra_jax.b2.track import RAIL_HALF, RAIL_OFFSET, SLEEPER_HALF, Track

N_SLEEPERS = 4  # ± 1 m about the robot, which is further than its feet reach
_HALF_DEPTH, _RAIL_LENGTH = 0.05, 1.8
_BED, _RAIL_COLOUR, _SLEEPER_COLOUR = (0.35, 0.33, 0.31, 1.0), (0.45, 0.40, 0.38, 1.0), (0.55, 0.55, 0.53, 1.0)


@dataclasses.dataclass(frozen=True)
class WindowConfig:
    """What of the track is there to be touched.

    Attributes:
        rails: Whether there are rails.
        max_contacts: Contacts that are resolved at once, the deepest first; 0 resolves all of them.
    """

    rails: bool = True
    max_contacts: int = 8


def add_window(spec: mujoco.MjSpec, config: WindowConfig) -> None:
    """Adds the mocap bodies, in the order in which `poses` gives them."""
    bed = spec.worldbody.add_body(name="bed", mocap=True)
    bed.add_geom(name="bed", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(3.0, 2.8, 1.0), rgba=_BED, **_touched())
    for k in range(N_SLEEPERS):
        _add_box(spec, f"sleeper_{k}", (*SLEEPER_HALF, _HALF_DEPTH), _SLEEPER_COLOUR)
    for side in ("left", "right") if config.rails else ():
        _add_box(spec, f"rail_{side}", (_RAIL_LENGTH, *RAIL_HALF), _RAIL_COLOUR)
    if config.max_contacts:
        spec.add_numeric(name="max_contact_points", size=1, data=[float(config.max_contacts)])


def poses(
    track: Track, anchor: Int[Array, ""], ahead: Float[Array, ""], config: WindowConfig
) -> tuple[Float[Array, "n_mocap 3"], Float[Array, "n_mocap 4"]]:
    """Where the mocap bodies are to be, from the anchor.

    Args:
        track: The track.
        anchor: The sleeper nearest to the robot.
        ahead: How far the robot is ahead of it, m.
        config: What of the track there is.

    Returns:
        Positions (m) and quaternions.
    """
    first = jnp.clip(anchor - jnp.where(ahead < 0.0, 2, 1), 0, track.station.shape[0] - N_SLEEPERS)
    origin, turned = track.position[anchor], track.quaternion[anchor]
    near = lax.dynamic_slice_in_dim(track.position, first, N_SLEEPERS) - origin
    turns = lax.dynamic_slice_in_dim(track.quaternion, first, N_SLEEPERS)
    sink = jnp.array([0.0, 0.0, -_HALF_DEPTH])
    positions = [rotation.rotate(turned, jnp.stack([0.0, 0.0, -track.protrusion]))]
    positions += [near[k] + rotation.rotate(turns[k], sink) for k in range(N_SLEEPERS)]
    quaternions = [turned, *turns]
    if config.rails:
        for side in (1.0, -1.0):
            positions.append(rotation.rotate(turned, jnp.array([0.0, side * RAIL_OFFSET, RAIL_HALF[1]])))
            quaternions.append(turned)
    return jnp.stack(positions), jnp.stack(quaternions)


def follow(
    track: Track, anchor: Int[Array, ""], position: Float[Array, "3"]
) -> tuple[Int[Array, ""], Float[Array, "3"]]:
    """The anchor that a robot has moved on to, at most one sleeper further, and its position from there.

    Args:
        track: The track.
        anchor: The anchor so far.
        position: Of the robot from that, m.
    """
    last = track.station.shape[0] - 1
    ahead = rotation.rotate(rotation.inverse(track.quaternion[anchor]), position)[0]
    after, before = (track.station[jnp.clip(anchor + step, 0, last)] - track.station[anchor] for step in (1, -1))
    step = jnp.where(
        (ahead > 0.5 * after) & (anchor < last), 1, jnp.where((ahead < 0.5 * before) & (anchor > 0), -1, 0)
    )
    moved = anchor + step
    # Differences of stored positions are exact: nothing adds up along the tunnel.
    return moved, position - (track.position[moved] - track.position[anchor])


def _touched() -> dict[str, int]:
    return {"contype": b2.GROUND, "conaffinity": 0, "group": 1}


def _add_box(spec: mujoco.MjSpec, name: str, half: tuple[float, ...], colour: tuple[float, ...]) -> None:
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=colour, **_touched())
