"""Ground and walls by physics: measured sleepers, rails, bed and lining, of which a window follows the robot.

Positions are given from the nearest row of the track, the *anchor*: coordinates stay small however long the tunnel is.
Each ball or wheel meets the tangent planes of what is nearest to it, so that the cost does not depend on the tunnel.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from subterra_jax.host.errors import SubterraError
from subterra_jax.parts.unicycle import nearest_wall
from subterra_jax.physics.rotations import inverse, rotate
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.shell import Shell

SPACING = 0.6  # of sleepers, and of the rows of a floor without; the paper's, m
SLEEPER_HALF = (0.10, 1.25)  # half the width of its top, half its length, m; docs/formats.md
RAIL_OFFSET = (1.435 + 0.073) / 2  # half gauge and head: from the axis to the middle of a rail, m
RAIL_HALF = (0.0365, 0.093)  # half the width of the head; half of pad and rail, 10 mm and 176 mm (CHN60), m
MIN_ROWS = 8
N_WINDOW = 4  # rows in the window: ± 1 m about the robot, further than wheels and feet reach
N_PLANES = 2  # planes that one ball or wheel can touch at once
_FAR = 1.0  # gap to what is not there, m
_BEYOND, _ASIDE = 5.0, 1.0  # sleepers so far outside the stretch, or aside of the first track, are not taken, m
_SLAB = 1.0  # half the width from which a flat brick is the bed, m


class TrackError(SubterraError):
    """There is no ground to stand on."""


@struct.dataclass
class Track:
    """Ground of a tunnel in order of station, or of several whose rows follow one another."""

    station: Float[Array, "rows"]  # station of each row, m
    position: Float[Array, "rows 3"]  # middle of each sleeper's top, or of the floor, tunnel frame, m
    quaternion: Float[Array, "rows 4"]  # rotation of each: x along the track, y to the left, z up, with cant and grade
    protrusion: Float[Array, "rows"]  # height of its sleepers above the ballast, m; 0 on a floor without sleepers
    rails: Float[Array, "rows"]  # 1 where there are rails, else 0
    first: Int[Array, "rows"]  # first row of its tunnel
    last: Int[Array, "rows"]  # last row of its tunnel
    tunnel: Int[Array, "rows"]  # number of its tunnel in the stack

    def nearest(self, station: Float[Array, ""], tunnel: Int[Array, ""] | int = 0) -> Int[Array, ""]:
        """Return the row of a tunnel nearest to a station."""
        away = jnp.where(self.tunnel == tunnel, jnp.abs(self.station - station), jnp.inf)
        return jnp.argmin(away).astype(jnp.int32)


def read_track(plan: TunnelPlan) -> Track:
    """Read the ground of a plan: its sleepers as measured, or its floor where it has none.

    Raises:
        TrackError: The tunnel is too short to stand in.
    """
    bricks = np.zeros((0, 13)) if plan.shell is None else plan.shell.track
    tops, turns, station = _sleepers(plan, bricks[bricks[:, 12] > 0.0])
    sleepers = len(tops) >= MIN_ROWS
    if not sleepers:
        station = np.arange(int(plan.length / SPACING + 1e-6) + 1) * SPACING
        tops, turns = _floor(plan, station)
    if len(station) < MIN_ROWS:
        raise TrackError(f"tunnel {plan.name!r} of {plan.length:.1f} m is too short for a robot with mass")
    rows = np.ones(len(station), np.float32)
    put = lambda values, kind=np.float32: jax.device_put(np.asarray(values, kind))  # noqa: E731
    return Track(
        station=put(station),
        position=put(tops),
        quaternion=put(turns),
        protrusion=put((_protrusion(tops, bricks, plan.shell) if sleepers else 0.0) * rows),
        rails=put(float(sleepers) * rows),
        first=put(0.0 * rows, np.int32),
        last=put((len(rows) - 1) * rows, np.int32),
        tunnel=put(0.0 * rows, np.int32),
    )


def join_tracks(tracks: Sequence[Track]) -> Track:
    """Join the grounds of several tunnels, in order."""
    before = np.cumsum([0, *(len(track.station) for track in tracks[:-1])]).tolist()
    moved = [
        dataclasses.replace(track, first=track.first + row, last=track.last + row, tunnel=track.tunnel + k)
        for k, (track, row) in enumerate(zip(tracks, before, strict=True))
    ]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *moved)


def _sleepers(plan: TunnelPlan, bricks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tops (m), rotations and stations (m) of the first track's sleepers, along growing station."""
    half = bricks[:, 3:12].reshape(-1, 3, 3)
    tops = bricks[:, :3] + half[:, 2]
    nearest = np.array([np.argmin(np.sum((plan.centre - top[:2]) ** 2, axis=1)) for top in tops], int)
    away, tangent = tops[:, :2] - plan.centre[nearest], plan.tangent[nearest]
    station = plan.station[nearest] + np.sum(away * tangent, axis=1)
    lateral = tangent[:, 0] * away[:, 1] - tangent[:, 1] * away[:, 0]
    kept = (station > -_BEYOND) & (station < plan.length + _BEYOND)
    kept &= np.abs(lateral - (lateral[:1] if len(lateral) else 0.0)) < _ASIDE
    order = np.flatnonzero(kept)[np.argsort(station[kept], kind="stable")]
    axes = half[order] / np.linalg.norm(half[order], axis=2, keepdims=True)
    return tops[order], _quaternions(axes), station[order]


def _floor(plan: TunnelPlan, station: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (m) and rotations of the floor at stations, level across the axis, at the height of the tunnel's file."""
    columns = np.column_stack([plan.centre, plan.elevation, plan.tangent])
    x, y, z, tangent_x, tangent_y = (np.interp(station, plan.station, column) for column in columns.T)
    yaw, pitch = np.arctan2(tangent_y, tangent_x), np.arctan(np.gradient(z, station)) if len(station) > 1 else 0.0 * z
    ahead = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    left = np.stack([-np.sin(yaw), np.cos(yaw), 0.0 * yaw], axis=1)
    return np.column_stack([x, y, z]), _quaternions(np.stack([ahead, left, np.cross(ahead, left)], axis=1))


def _quaternions(axes: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 4"]:
    """Rotations whose axes ahead, left and up are the rows of each matrix."""
    from scipy.spatial.transform import Rotation  # half a second to import

    matrices = np.swapaxes(axes, 1, 2)
    return Rotation.from_matrix(matrices).as_quat()[:, [3, 0, 1, 2]] if len(axes) else np.zeros((0, 4))


def _protrusion(tops: Float[np.ndarray, "k 3"], bricks: np.ndarray, shell: Any) -> float:
    """Median height of the sleepers' tops over the slab of ballast nearest to each, or over the bare floor, m."""
    beds = bricks[(bricks[:, 12] == 0.0) & (np.linalg.norm(bricks[:, 6:9], axis=1) > _SLAB)]
    heights = []
    for top in tops:
        if len(beds) == 0:
            heights.append(_over_floor(top, shell))
            continue
        bed = beds[int(np.argmin(np.sum((beds[:, :2] - top[:2]) ** 2, axis=1)))]
        half = float(np.linalg.norm(bed[9:12]))
        heights.append(float((top - bed[:3]) @ bed[9:12]) / half - half)
    return max(float(np.median(heights)), 0.0)


def _over_floor(point: Float[np.ndarray, "3"], shell: Shell) -> float:
    """Height of a point over the lower half of the nearest section, m."""
    row = int(np.argmin(np.sum((shell.position[:, :2] - point[:2]) ** 2, axis=1)))
    away, low = point - shell.position[row], np.flatnonzero(np.sin(shell.angle) < 0.0)
    across, height = (shell.radius[row, low] * turn(shell.angle[low]) for turn in (np.cos, np.sin))
    order = np.argsort(across)
    return float(away @ shell.up[row] - np.interp(away @ shell.left[row], across[order], height[order]))


@struct.dataclass
class Window:
    """Ground and walls within reach in one control period; positions from the anchor."""

    origin: Float[Array, "3"]  # position of the anchor, tunnel frame, m
    position: Float[Array, "4 3"]  # middles of the nearest rows of the track, m
    axes: Float[Array, "4 3 3"]  # axes of each: ahead, left, up
    protrusion: Float[Array, ""]  # as for `Track`
    rails: Float[Array, ""]  # as for `Track`
    wall: Float[Array, "n 3"]  # nearest point of a wall to each bumper, m
    away: Float[Array, "n 3"]  # level unit vector from that point to the bumper
    gap: Float[Array, "n"]  # distance between them, m; exact below 0.8 m


def look_around(
    track: Track,
    tunnel: Tunnel,
    anchor: Int[Array, ""],
    qpos: Float[Array, "n_qpos"],
    bumpers: Float[np.ndarray, "n 3"],
) -> tuple[Window, Float[Array, ""]]:
    """Return the window about a robot, and its station, m.

    Args:
        anchor: Row nearest to the robot.
        qpos: Position of its trunk from there, m, its rotation, and whatever follows.
        bumpers: Places on the trunk that are kept out of walls, m.
    """
    origin, turn = track.position[anchor], track.quaternion[anchor]
    ahead = rotate(inverse(turn), qpos[:3])[0]
    station = track.station[anchor] + ahead
    row = jnp.clip(anchor - jnp.where(ahead < 0.0, 2, 1), track.first[anchor], track.last[anchor] - N_WINDOW + 1)
    turns = lax.dynamic_slice_in_dim(track.quaternion, row, N_WINDOW)
    unit = jnp.eye(3)
    axes = jnp.stack([jnp.stack([rotate(turns[k], unit[i]) for i in range(3)]) for k in range(N_WINDOW)])
    near = lax.dynamic_slice_in_dim(track.position, row, N_WINDOW) - origin
    places = jnp.stack([qpos[:3] + rotate(qpos[3:7], jnp.asarray(bumper, jnp.float32)) for bumper in bumpers])
    to_wall = jnp.stack([nearest_wall(tunnel, origin[:2] + place[:2], station) for place in places])
    gap = jnp.sqrt(jnp.maximum(jnp.sum(to_wall * to_wall, axis=1), 1e-8))
    level = jnp.concatenate([to_wall, jnp.zeros((len(bumpers), 1))], axis=1)
    return Window(
        origin, near, axes, track.protrusion[anchor], track.rails[anchor], places + level, -level / gap[:, None], gap
    ), station


def touched_planes(
    window: Window, centre: Float[Array, "3"], axle: Float[Array, "3"], radius: float, half_width: float | None
) -> tuple[Float[Array, "2 3"], Float[Array, "2 3"]]:
    """Return a point and the normal of the nearest two planes that a ball or wheel may touch.

    A ball of `radius` at the centre is as far from each plane as the ball or wheel is from what it stands for.

    Args:
        window: What is near.
        centre: Its middle, from the anchor, m.
        axle: Unit vector along the axle of a wheel.
        radius: Its radius, m.
        half_width: Half the width of a wheel's tread, m; None for a ball.
    """
    origin, left, up, (position, axes) = _frame_at(window, centre)
    from_axis = centre - origin
    across, height = jnp.sum(from_axis * left), jnp.sum(from_axis * up)
    bed = height + window.protrusion
    # A rail is a box along the track: from the ballast to its head.
    side, wide = jnp.where(across < 0.0, -1.0, 1.0), jnp.abs(across)
    out = wide - jnp.clip(wide, RAIL_OFFSET - RAIL_HALF[0], RAIL_OFFSET + RAIL_HALF[0])
    above = jnp.maximum(height - 2.0 * RAIL_HALF[1], 0.0)
    rail, rail_normal = _direction(out * side * left + above * up, up)
    # So is the nearest sleeper; who is in it is pushed up.
    along, aside, over = (jnp.sum((centre - position) * axes[i]) for i in range(3))
    x, y = (part - jnp.clip(part, -half, half) for part, half in zip((along, aside), SLEEPER_HALF, strict=True))
    sleeper, sleeper_normal = _direction(x * axes[0] + y * axes[1] + jnp.maximum(over, 0.0) * axes[2], axes[2])
    sleeper = jnp.where((x == 0.0) & (y == 0.0), over, sleeper)
    distance = jnp.stack([bed, sleeper, rail])
    normal = jnp.stack([up, sleeper_normal, rail_normal])
    present = jnp.stack([jnp.ones(()), window.protrusion, window.rails]) > 0.0
    gap = jnp.where(present, distance - _support(normal, axle, radius, half_width), _FAR)
    worst = jnp.argmax(gap)
    first, second = jnp.where(worst == 0, 1, 0), jnp.where(worst == 2, 1, 2)
    chosen = jnp.stack([first, second])
    gap, normal = gap[chosen], normal[chosen]
    return centre - (radius + gap)[:, None] * normal, normal


def _support(
    normal: Float[Array, "3 3"], axle: Float[Array, "3"], radius: float, half_width: float | None
) -> Float[Array, "3"]:
    """Distance from the middle of a ball or wheel to its outermost point against each normal, m."""
    if half_width is None:
        return jnp.full(normal.shape[0], radius)
    lean = jnp.sum(normal * axle, axis=1)
    return radius * jnp.sqrt(jnp.maximum(1.0 - lean * lean, 0.0)) + half_width * jnp.abs(lean)


def _direction(vector: Float[Array, "3"], otherwise: Float[Array, "3"]) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Length of a vector, m, and its direction; another direction where it has no length."""
    size = jnp.sqrt(jnp.maximum(jnp.sum(vector * vector), 1e-12))
    return size, jnp.where(size > 2e-6, vector / size, otherwise)


def _frame_at(window: Window, centre: Float[Array, "3"]) -> tuple[Array, Array, Array, tuple[Array, Array]]:
    """Point of the track below a centre, m, its axes left and up; and place and axes of the nearest row."""
    position, axes = window.position, window.axes
    chord = position[-1] - position[0]
    chord = chord / jnp.sqrt(jnp.sum(chord * chord))
    along, place = jnp.sum(position * chord, axis=1), jnp.sum(centre * chord)
    row = jnp.sum((place > along[1:-1]).astype(jnp.int32))
    fraction = (place - along[row]) / (along[row + 1] - along[row])
    origin = position[row] + fraction * (position[row + 1] - position[row])
    left, up = (axes[row, i] + jnp.clip(fraction, 0.0, 1.0) * (axes[row + 1, i] - axes[row, i]) for i in (1, 2))
    nearest = jnp.argmin(jnp.abs(along - place))
    return origin, left, up, (position[nearest], axes[nearest])


def move_anchor(
    track: Track, anchor: Int[Array, ""], position: Float[Array, "3"]
) -> tuple[Int[Array, ""], Float[Array, "3"]]:
    """Move the anchor by at most one row after the robot.

    Args:
        anchor: The anchor so far.
        position: Position of the robot from that anchor, m.

    Returns:
        The new anchor, and the robot's position from it, m.
    """
    first, last = track.first[anchor], track.last[anchor]
    ahead = rotate(inverse(track.quaternion[anchor]), position)[0]
    after, before = (track.station[jnp.clip(anchor + step, first, last)] - track.station[anchor] for step in (1, -1))
    step = jnp.where(
        (ahead > 0.5 * after) & (anchor < last), 1, jnp.where((ahead < 0.5 * before) & (anchor > first), -1, 0)
    )
    new = anchor + step
    # Differences of stored positions are exact: nothing adds up along the tunnel.
    return new, position - (track.position[new] - track.position[anchor])
