"""The track under the robot's feet: where each sleeper lies, from a built scene or by standard along a tunnel."""

from pathlib import Path
from xml.etree import ElementTree

import jax
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.errors import SubterraError
from subterra_jax.tunnel.plan import TunnelPlan

# By standard, m. Source: docs/formats.md and the paper (spacing); the same that the scene's builder lays.
SPACING, PROTRUSION = 0.6, 0.06
SLEEPER_HALF = (0.10, 1.25)  # half the width of its top, half its length
RAIL_OFFSET = (1.435 + 0.073) / 2  # half gauge and head: from the axis to the middle of a rail
RAIL_HALF = (0.0365, 0.093)  # half the width of the head; half of pad and rail, 10 mm and 176 mm (CHN60)
MIN_SLEEPERS = 8


class TrackError(SubterraError):
    """There is no track to walk on."""


@struct.dataclass
class Track:
    """Sleepers in order of station; `quaternion` turns x along the track, y to the left, z up, cant and grade included.

    Attributes:
        station: m.
        position: Of the middle of each sleeper's top, tunnel frame, m.
        quaternion: Of each sleeper, real part first.
        protrusion: How far sleepers stand out of the ballast, m.
    """

    station: Float[Array, "k"]
    position: Float[Array, "k 3"]
    quaternion: Float[Array, "k 4"]
    protrusion: Float[Array, ""]


def by_standard(plan: TunnelPlan) -> Track:
    """Sleepers every 0.6 m along the centreline, level across, at the height that the tunnel's file gives them.

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
    return _track(station, np.column_stack([x, y, z]), _turned(yaw, pitch), PROTRUSION)


def from_scene(folder: Path, plan: TunnelPlan) -> Track:
    """The sleepers of a built scene, as they lie there.

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
        if name.startswith("sleeper_"):
            sleepers.append(_place(geom))
        elif name.startswith("bed_"):
            beds.append((*_place(geom), float(geom.get("size", "0 0 0").split()[2])))
    if len(sleepers) < MIN_SLEEPERS:
        raise TrackError(f"{path}: {len(sleepers)} sleepers: the scene has no track to walk on")
    position, quaternion = (np.array(part) for part in zip(*sleepers, strict=True))
    station = _stations(plan, position[:, :2])
    order = np.argsort(station, kind="stable")
    return _track(station[order], position[order], quaternion[order], _protrusion(position, beds))


def _place(geom: ElementTree.Element) -> tuple[np.ndarray, np.ndarray]:
    position = np.array([float(number) for number in geom.get("pos", "0 0 0").split()])
    return position, np.array([float(number) for number in geom.get("quat", "1 0 0 0").split()])


def _track(station: np.ndarray, position: np.ndarray, quaternion: np.ndarray, protrusion: float) -> Track:
    unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    parts = [jax.device_put(np.asarray(part, np.float32)) for part in (station, position, unit, protrusion)]
    return Track(*parts)


def _turned(yaw: np.ndarray, pitch: np.ndarray) -> np.ndarray:
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
