"""`tunnel.npz`: walls cut at LiDAR height above the track, as polylines, and the bore in three dimensions."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, Mesh64
from scipy.spatial.transform import Rotation

from scene.bore import Bore
from scene.errors import FitError, Refusal
from scene.writing.mesh import has_rings
from scene.writing.track import TrackConfig
from subterra_jax.host.tunnelfile import write_tunnel

_SEEN = ("0", "1")  # groups of geoms that a camera sees


@dataclass(frozen=True)
class Variant:
    """One lining of the tunnel file."""

    bore: Bore  # With the recesses that its wall is unrolled with
    recesses: bool  # True where they are cut
    scene: Path  # MJCF file that draws it


def seams(variants: dict[str, Variant]) -> dict[str, float]:
    """Return the angle at which the wall of each variant is cut open to be unrolled, rad, by field."""
    return {f"shell_seam_{name}": float(each.bore.unrolled().angle[0]) for name, each in variants.items()}


def shell_fields(
    bore: Bore, elevation: Float[np.ndarray, " n"], track: TrackConfig, variants: dict[str, Variant]
) -> dict[str, np.ndarray]:
    """Return the bore in three dimensions as arrays by field name; docs/formats.md says what each means.

    `variants` are keyed by the names of the linings; boxes that all of them draw are the track.
    """
    scenes = {variant.scene: _read_bricks(variant.scene, track) for variant in variants.values()}
    common = set.intersection(*(set(bricks) for bricks in scenes.values()))
    first = next(iter(scenes.values()))
    fields: dict[str, np.ndarray] = {
        "shell_height": bore.position[:, 2] - elevation, "shell_rise": bore.tangent[:, 2], "shell_angle": bore.angle,
        "shell_section": bore.radius.mean(axis=0), "shell_radius": bore.radius,
        "shell_track": _rows([row for name, row in first.items() if name in common]),
    }  # fmt: skip
    for name, variant in variants.items():
        pocket = variant.bore.pocket if variant.recesses else variant.bore.pocket[:0]
        columns = [pocket[field] for field in ("station", "angle", "length", "width", "depth")]
        fields[f"shell_pocket_{name}"] = np.stack(columns, axis=-1)
        own = [row for brick, row in scenes[variant.scene].items() if brick not in common]
        fields[f"shell_brick_{name}"] = _rows(own)
    return fields


def _rows(rows: list[np.ndarray]) -> Float[np.ndarray, "k 13"]:
    return np.array(rows, float).reshape(-1, 13)


def _read_bricks(scene: Path, track: TrackConfig) -> dict[str, Float[np.ndarray, "13"]]:
    """Return visible boxes and sleepers of a scene by name: middle, half edges as three vectors, taper."""
    bricks = {}
    width = (track.sleeper_top + track.sleeper_bottom) / 4
    sleeper = np.array([width, track.sleeper_length / 2, track.sleeper_height / 2])
    for geom in ET.parse(scene).getroot().iterfind("worldbody/geom"):
        is_box = geom.get("type") == "box" and geom.get("group") in _SEEN
        if not (is_box or geom.get("mesh") == "sleeper"):
            continue
        w, x, y, z = np.array(geom.get("quat", "1 0 0 0").split(), float)
        frame = Rotation.from_quat([x, y, z, w]).as_matrix()
        centre = np.array(geom.get("pos", "0 0 0").split(), float)
        half = np.array(geom.get("size", "0 0 0").split(), float) if is_box else sleeper
        if not is_box:
            centre = centre - sleeper[2] * frame[:, 2]
        taper = 0.0 if is_box else 1.0 - track.sleeper_top / 2 / width
        bricks[geom.get("name", "")] = np.array([*centre, *(frame * half).T.ravel(), taper])
    return bricks


_SAME_JOINT = 0.4  # m: less than a ring is wide
_COLLINEAR = 0.001  # m; half of it would add half as many vertices to a smooth wall


@dataclass(frozen=True)
class Walls:
    """Both walls of one variant at LiDAR height, in the direction of growing station."""

    left: Float[np.ndarray, "k 2"]  # m
    right: Float[np.ndarray, "l 2"]  # m
    left_station: Float[np.ndarray, " k"]  # Station of each vertex, not decreasing, m
    right_station: Float[np.ndarray, " l"]  # Station of each vertex, not decreasing, m


def cut_walls(solid: Manifold, bore: Bore, elevation: Float[np.ndarray, " n"], height: float) -> Walls:
    """Cuts the solid by a surface `height` m above the track, whose z at each station is `elevation`, m.

    The solid is levelled first (each vertex lowered by the track's elevation at its station), so that the cut follows
    the grade. Raises `FitError` where there is no wall on both sides at that height.
    """
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties[:, :3])
    axis = bore.axis
    station = axis.local(vertices)[0]
    vertices[:, 2] -= np.interp(station, bore.station, elevation)
    level = Manifold(Mesh64(vertices, np.array(mesh.tri_verts)))
    polygons = level.slice(height).simplify(_COLLINEAR).to_polygons()
    if not polygons:
        raise FitError(f"no wall {height:g} m above the track: the bore is not that high there", Refusal.LEVEL)
    outline = max(polygons, key=lambda polygon: CrossSection([polygon]).area())
    plan = axis.in_plan()
    along, across, _ = plan.local(np.column_stack([outline, np.zeros(len(outline))]))
    left, right = across > 0, across <= 0
    if left.sum() < 2 or right.sum() < 2:
        raise FitError(f"no wall on both sides {height:g} m above the track", Refusal.LEVEL)
    # The outline runs counter-clockwise: forward along the right wall, back along the left one.
    first = int(np.flatnonzero(right & ~np.roll(right, 1))[0])
    order = np.roll(np.arange(len(outline)), -first)
    if np.any(np.diff(right[order].astype(int)) > 0):
        why = f"{height:g} m above the track the outline crosses the centreline; is there a branch?"
        raise FitError(why, Refusal.LEVEL)
    right_order, left_order = order[right[order]], order[left[order]][::-1]
    return Walls(
        outline[left_order],
        outline[right_order],
        np.maximum.accumulate(np.clip(along[left_order], 0.0, bore.length)),
        np.maximum.accumulate(np.clip(along[right_order], 0.0, bore.length)),
    )


def half_widths(walls: Walls, bore: Bore) -> Float[np.ndarray, " n"]:
    """Return half the distance of the walls at each station, m."""
    plan = bore.axis.in_plan()

    def across(wall: np.ndarray, station: np.ndarray) -> np.ndarray:
        return np.interp(bore.station, station, plan.local(np.column_stack([wall, np.zeros(len(wall))]))[1])

    return (across(walls.left, walls.left_station) - across(walls.right, walls.right_station)) / 2


def ring_pitch(bore: Bore) -> float:
    """Return the distance from ring joint to ring joint, to a millimetre as on drawings, m; 0 where there are none.

    A ring survey may have only some of its rings; the joints are then those of its lining by standard, or those that
    the laid nails bridge.
    """
    joints = bore.ring_joint if len(bore.ring_joint) else bore.ring_station
    if not len(bore.ring_joint) and not has_rings(bore):
        at = np.sort(bore.nail["station"])
        joints = at[np.diff(at, prepend=-np.inf) > _SAME_JOINT]
    return round(float(np.median(np.diff(joints))), 3) if len(joints) > 1 else 0.0


def save_tunnel(
    path: Path,
    name: str,
    provenance: str,
    bore: Bore,
    elevation: Float[np.ndarray, " n"],
    lidar_height: float,
    variants: dict[str, Walls],
    furniture: dict[str, Float[np.ndarray, "f 4"]] | None = None,
    shell: dict[str, np.ndarray] | None = None,
    seams: dict[str, float] | None = None,
) -> None:
    """Writes `tunnel.npz`; docs/formats.md says what each field means.

    `elevation` is the track's z at each station, and `lidar_height` that of the LiDAR's plane above it, m. `variants`
    are walls by the name of the lining, `smooth` first, and `furniture` segments beside them, m. Without `shell` (of
    `shell_fields`) and `seams` the file holds the plane alone.
    """
    plan = bore.axis.in_plan()
    facts = {
        "name": name, "provenance": provenance, "lidar_height": lidar_height, "ring_pitch": ring_pitch(bore),
        "lining": list(variants), **(seams or {}),
    }  # fmt: skip
    arrays = {
        "station": bore.station, "centre": plan.position[:, :2], "tangent": plan.tangent[:, :2], "elevation": elevation,
        "half_width": half_widths(variants["smooth"], bore), **(shell or {}),
    }  # fmt: skip
    for variant, walls in variants.items():
        arrays |= {f"left_{variant}": walls.left, f"left_station_{variant}": walls.left_station}
        arrays |= {f"right_{variant}": walls.right, f"right_station_{variant}": walls.right_station}
        arrays[f"furniture_{variant}"] = (furniture or {}).get(variant, np.empty((0, 4)))
    write_tunnel(path, facts, arrays)
