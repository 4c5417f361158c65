"""The track under the robot's feet: its sleepers, and a window of it that follows the robot.

The sleepers come from a built scene, or are laid by standard along a tunnel. The window holds ballast, the four
nearest sleepers and two rails as mocap bodies, so that its cost does not depend on the tunnel's length. It is given
relative to the nearest sleeper, the *anchor*, whose middle is the origin of the physics: coordinates stay small
however long the tunnel is.
"""

import dataclasses
from pathlib import Path
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import inverse, rotate
from subterra_jax.host.errors import SubterraError
from subterra_jax.tunnel.plan import TunnelPlan

# By standard, m. Source: docs/formats.md and the paper (spacing); the scene's builder lays the same.
SPACING, PROTRUSION = 0.6, 0.06
SLEEPER_HALF = (0.10, 1.25)  # half the width of its top, half its length
RAIL_OFFSET = (1.435 + 0.073) / 2  # half gauge and head: from the axis to the middle of a rail
RAIL_HALF = (0.0365, 0.093)  # half the width of the head; half of pad and rail, 10 mm and 176 mm (CHN60)
MIN_SLEEPERS = 8
N_SLEEPERS = 4  # in the window: ± 1 m about the robot, which is further than its feet reach
_HALF_DEPTH, _RAIL_LENGTH = 0.05, 1.8  # of a sleeper's box, of half a rail in the window, m
_BED, _RAIL_COLOUR, _SLEEPER_COLOUR = (0.35, 0.33, 0.31, 1.0), (0.45, 0.40, 0.38, 1.0), (0.55, 0.55, 0.53, 1.0)


class TrackError(SubterraError):
    """There is no track to walk on."""


@struct.dataclass
class Track:
    """Sleepers in order of station."""

    station: Float[Array, "k"]  # station of each sleeper, m
    position: Float[Array, "k 3"]  # middle of each sleeper's top, tunnel frame, m
    # rotation of each sleeper: x along the track, y to the left, z up, with cant and grade
    quaternion: Float[Array, "k 4"]
    protrusion: Float[Array, ""]  # height of the sleepers above the ballast, m


@dataclasses.dataclass(frozen=True)
class WindowConfig:
    """The part of the track that can be touched."""

    rails: bool = True  # whether there are rails
    max_contacts: int = 8  # contacts resolved at once, the deepest first; 0 resolves all of them


def lay_standard_track(plan: TunnelPlan) -> Track:
    """Lays sleepers every 0.6 m along the centreline, level across, at the elevation of the tunnel's file.

    Raises:
        TrackError: The tunnel is too short for a track.
    """
    count = int(plan.length / SPACING + 1e-6) + 1
    if count < MIN_SLEEPERS:
        raise TrackError(f"tunnel {plan.name!r} of {plan.length:.1f} m is too short for a track")
    station = np.arange(count) * SPACING
    columns = np.column_stack([plan.centre, plan.elevation, plan.tangent])
    x, y, z, tangent_x, tangent_y = (np.interp(station, plan.station, column) for column in columns.T)
    yaw, pitch = np.arctan2(tangent_y, tangent_x), -np.arctan(np.gradient(z, station))
    return _make_track(station, np.column_stack([x, y, z]), _quaternions(yaw, pitch), PROTRUSION)


def read_scene_track(folder: Path, plan: TunnelPlan) -> Track:
    """Reads the sleepers of a built scene.

    Args:
        folder: Scene folder with `scene.xml`.
        plan: The tunnel of the same folder.

    Raises:
        TrackError: There is no readable scene, or no track in it.
    """
    path = folder / "scene.xml"
    try:
        geoms = ElementTree.parse(path).getroot().iter("geom")
    except (OSError, ElementTree.ParseError) as error:
        raise TrackError(f"{path}: not a readable scene ({error})") from error
    sleepers, beds = [], []
    for geom in geoms:
        name = geom.get("name", "")
        if name.startswith("sleeper_") and not name.startswith("sleeper_2_"):  # of two tracks it walks on the first
            sleepers.append(_geom_pose(geom))
        elif name.startswith("bed_"):
            beds.append((*_geom_pose(geom), float(geom.get("size", "0 0 0").split()[2])))
    if len(sleepers) < MIN_SLEEPERS:
        raise TrackError(f"{path}: {len(sleepers)} sleepers: the scene has no track to walk on")
    position, quaternion = (np.array(part) for part in zip(*sleepers, strict=True))
    station = _stations(plan, position[:, :2])
    order = np.argsort(station, kind="stable")
    return _make_track(station[order], position[order], quaternion[order], _protrusion(position, beds))


def _geom_pose(geom: ElementTree.Element) -> tuple[np.ndarray, np.ndarray]:
    position = np.array([float(number) for number in geom.get("pos", "0 0 0").split()])
    return position, np.array([float(number) for number in geom.get("quat", "1 0 0 0").split()])


def _make_track(station: np.ndarray, position: np.ndarray, quaternion: np.ndarray, protrusion: float) -> Track:
    """A track of 32-bit device arrays with unit quaternions."""
    unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    parts = [jax.device_put(np.asarray(part, np.float32)) for part in (station, position, unit, protrusion)]
    return Track(*parts)


def _quaternions(yaw: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Quaternions of a yaw, and a pitch (nose down positive) about the turned y."""
    (cos_y, sin_y), (cos_p, sin_p) = ((np.cos(0.5 * angle), np.sin(0.5 * angle)) for angle in (yaw, pitch))
    return np.column_stack([cos_y * cos_p, -sin_y * sin_p, cos_y * sin_p, sin_y * cos_p])


def _stations(plan: TunnelPlan, points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
    """Station of the foot of each point on the centreline, m."""
    nearest = np.array([np.argmin(np.sum((plan.centre - point) ** 2, axis=1)) for point in points])
    beyond = np.sum((points - plan.centre[nearest]) * plan.tangent[nearest], axis=1)
    return plan.station[nearest] + beyond


def _protrusion(tops: Float[np.ndarray, "k 3"], beds: list[tuple[np.ndarray, np.ndarray, float]]) -> float:
    """Median height of the sleepers' tops over the slab of ballast nearest to each; by standard where there is none."""
    if not beds:
        return PROTRUSION
    middles = np.array([middle for middle, _, _ in beds])
    heights = []
    for top in tops:
        middle, (w, x, y, z), half = beds[int(np.argmin(np.sum((middles - top)[:, :2] ** 2, axis=1)))]
        normal = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
        heights.append(float(np.sum((top - middle) * normal)) - half)
    return max(float(np.median(heights)), 0.0)


def add_window(spec: mujoco.MjSpec, config: WindowConfig) -> None:
    """Adds the mocap bodies of the window, in the order in which `window_poses` gives them."""
    bed = spec.worldbody.add_body(name="bed", mocap=True)
    bed.add_geom(name="bed", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(3.0, 2.8, 1.0), rgba=_BED, **_contact_bits())
    for k in range(N_SLEEPERS):
        _add_box(spec, f"sleeper_{k}", (*SLEEPER_HALF, _HALF_DEPTH), _SLEEPER_COLOUR)
    for side in ("left", "right") if config.rails else ():
        _add_box(spec, f"rail_{side}", (_RAIL_LENGTH, *RAIL_HALF), _RAIL_COLOUR)
    if config.max_contacts:
        spec.add_numeric(name="max_contact_points", size=1, data=[float(config.max_contacts)])


def _contact_bits() -> dict[str, int]:
    return {"contype": b2.GROUND, "conaffinity": 0, "group": 1}


def _add_box(spec: mujoco.MjSpec, name: str, half: tuple[float, ...], colour: tuple[float, ...]) -> None:
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=colour, **_contact_bits())


def window_poses(
    track: Track, anchor: Int[Array, ""], ahead: Float[Array, ""], config: WindowConfig
) -> tuple[Float[Array, "n_mocap 3"], Float[Array, "n_mocap 4"]]:
    """Computes the positions (m, from the anchor) and quaternions of the window's mocap bodies.

    Args:
        track: The track.
        anchor: Index of the sleeper nearest to the robot.
        ahead: Distance of the robot ahead of the anchor, m.
        config: Parts of the track that exist.
    """
    first = jnp.clip(anchor - jnp.where(ahead < 0.0, 2, 1), 0, track.station.shape[0] - N_SLEEPERS)
    origin, along_track = track.position[anchor], track.quaternion[anchor]
    near = lax.dynamic_slice_in_dim(track.position, first, N_SLEEPERS) - origin
    turns = lax.dynamic_slice_in_dim(track.quaternion, first, N_SLEEPERS)
    sink = jnp.array([0.0, 0.0, -_HALF_DEPTH])
    positions = [rotate(along_track, jnp.stack([0.0, 0.0, -track.protrusion]))]
    positions += [near[k] + rotate(turns[k], sink) for k in range(N_SLEEPERS)]
    quaternions = [along_track, *turns]
    if config.rails:
        for side in (1.0, -1.0):
            positions.append(rotate(along_track, jnp.array([0.0, side * RAIL_OFFSET, RAIL_HALF[1]])))
            quaternions.append(along_track)
    return jnp.stack(positions), jnp.stack(quaternions)


def move_anchor(
    track: Track, anchor: Int[Array, ""], position: Float[Array, "3"]
) -> tuple[Int[Array, ""], Float[Array, "3"]]:
    """Moves the anchor by at most one sleeper after the robot.

    Args:
        track: The track.
        anchor: The anchor so far.
        position: Position of the robot from that anchor, m.

    Returns:
        The new anchor, and the robot's position from it, m.
    """
    last = track.station.shape[0] - 1
    ahead = rotate(inverse(track.quaternion[anchor]), position)[0]
    after, before = (track.station[jnp.clip(anchor + step, 0, last)] - track.station[anchor] for step in (1, -1))
    step = jnp.where(
        (ahead > 0.5 * after) & (anchor < last), 1, jnp.where((ahead < 0.5 * before) & (anchor > 0), -1, 0)
    )
    new = anchor + step
    # Differences of stored positions are exact: nothing adds up along the tunnel.
    return new, position - (track.position[new] - track.position[anchor])
