"""The released scene: files, rays, inventory, rail seats."""

from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from benchmarks.fidelity.candidate import Geoms, load_model, track_of
from benchmarks.fidelity.case import Case, per_case
from benchmarks.fidelity.derive.curve import candidate_curve, interpolate_rows
from benchmarks.fidelity.derive.mesh import face_parts
from benchmarks.fidelity.derive.surface import Caster, surface_caster
from benchmarks.fidelity.meshes import concatenate_meshes, connected_groups
from subterra_jax.host.tunnelfile import read_fields


def asset_files(scene: Path) -> list[Path]:
    root = ElementTree.parse(scene).getroot()
    compiler = root.find("compiler")
    where = compiler.attrib if compiler is not None else {}
    folders = {kind: scene.parent / where.get(f"{kind}dir", "") for kind in ("mesh", "texture")}
    files = {(kind, one.get("file")) for kind in ("mesh", "texture") for one in root.iter(kind) if one.get("file")}
    return [folders[kind] / str(name) for kind, name in sorted(files)]


def scene_model(case: Case) -> mujoco.MjModel:
    """Return the compiled scene.

    Raises:
        ValueError: MuJoCo refuses it.
    """
    return _compile_scene(case.candidate.scene, case.candidate.scene.stat().st_mtime_ns)


@lru_cache(maxsize=1)  # null tube, truth and most controls have the scene of the reconstruction
def _compile_scene(scene: Path, changed: int) -> mujoco.MjModel:
    model = load_model(scene)
    # Rays leave out one body at most, and a robot has wheels too.
    model.geom_group[np.isin(model.body_rootid[model.geom_bodyid], model.jnt_bodyid)] = _HIDDEN
    return model


@per_case
def scene_geoms(case: Case) -> Geoms:
    return Geoms.of(scene_model(case))


def placed_data(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def robot_body(model: mujoco.MjModel) -> int:
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            return int(model.jnt_bodyid[joint])
    raise ValueError("no body of the scene moves freely")


def lidar_elevation(case: Case, station: np.ndarray) -> np.ndarray:
    """Return the height of the environment's LiDAR plane at stations, tunnel frame, m."""
    tunnel = read_fields(case.candidate.tunnel)
    return np.interp(station, tunnel["station"], tunnel["elevation"]) + float(tunnel["lidar_height"])


def random_stations(case: Case, id: str, count: int, inset: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws random stations of the centreline, so that none lies in a ring of vertices.

    Returns:
        Stations (m, `(count,)`), positions on the centreline and unit vectors to the left, `(count, 3)`.
    """
    bore = case.candidate.bore
    station = np.sort(case.rng(id).uniform(bore.station[0] + inset, bore.station[-1] - inset, count))
    position, left = (interpolate_rows(station, bore.station, rows) for rows in (bore.position, bore.lateral))
    return station, position, left / np.linalg.norm(left, axis=1, keepdims=True)


# Rays in the compiled scene and in the meshes that it was made from.

LINING_NAMES = ("lining", "recess", "floor")  # what pieces of the lining are called
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)  # groups that a camera draws
_HIDDEN = 5  # group of what moves, where no ray sees it
_MESH_NAMES = {"bed", *LINING_NAMES, "sleeper", "rail", "fastening", "fastenings"}  # geoms of lining and track
_EYES = 100
_RAYS_PER_EYE = 1000


@per_case
def rays_from_axis(case: Case) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
    """Casts rays from the axis.

    Returns:
        Ranges by MuJoCo, and by embree in lining and track, m, `inf` for none; True where MuJoCo hit a part of those.
    """
    _, eye, _ = random_stations(case, "mj_ray_vs_mesh_mae", _EYES)
    way = case.rng("mj_ray_leak_rate").normal(size=(_EYES, _RAYS_PER_EYE, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    model = scene_model(case)
    reach, geom = scene_ranges(model, eye, way)
    mesh = surface_caster(case).first(np.repeat(eye, _RAYS_PER_EYE, axis=0), way.reshape(-1, 3))[0]
    # Nails and lamps are of the scene alone.
    ours = np.ones(model.ngeom + 1, bool)  # the last is for a ray that meets nothing
    ours[:-1] = np.isin(np.arange(model.ngeom), scene_geoms(case).named(*_MESH_NAMES))
    return reach, mesh, ours[geom]


def scene_ranges(
    model: mujoco.MjModel, eye: Float[np.ndarray, "e 3"], way: Float[np.ndarray, "e r 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return ranges by `mj_multiRay` in drawn geoms without the robot, m, `inf` for none, and the geoms hit."""
    data = placed_data(model)
    count = way.shape[1]
    reach, geom = np.empty((len(eye), count)), np.empty((len(eye), count), np.int32)
    for row in range(len(eye)):
        mujoco.mj_multiRay(
            model, data, eye[row], np.ascontiguousarray(way[row]).ravel(), VISIBLE_GROUPS, True, -1, geom[row],
            reach[row], None, count, mujoco.mjMAXVAL,
        )  # fmt: skip
    return np.where(reach < 0.0, np.inf, reach).ravel(), geom.ravel()


# Inventory: assets counted from geoms, fastenings by rail seat.

_PAD_HEIGHT = 0.03  # m; what is lower is a pad, what is higher a clip
_FASTENER_REACH = 0.10  # m between clip and shoulder
_SEAT_REACH = 0.20  # m between parts of the fastening of one seat


def count_assets(case: Case) -> dict[str, int]:
    """Counts assets of the compiled scene by the names of the manifest; a fastener is a clip with its shoulder."""
    names = scene_geoms(case).names
    middle, height = fastening_parts(track_of(scene_geoms(case)).fastening_mesh)
    pad = height <= _PAD_HEIGHT
    return {
        "sleepers": sum(name.startswith("sleeper_") for name in names),
        "rails": len({name.split("_")[1] for name in names if name.startswith("rail_")}),
        "fasteners": len(cluster_points(middle[~pad], _FASTENER_REACH)),
        "pads": int(pad.sum()),
        "lining_chunks": sum(name.startswith("lining") for name in names),
        "wall_panels": sum(name.startswith("wall_") for name in names),
    }


def fastening_parts(mesh: trimesh.Trimesh) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Return the middle and the vertical extent of each connected piece, m."""
    if not len(mesh.faces):
        return np.zeros((0, 3)), np.zeros(0)
    part = face_parts(mesh)
    order = np.argsort(part, kind="stable")
    corners = mesh.triangles[order].reshape(-1, 3)
    starts = 3 * np.searchsorted(part[order], np.arange(part.max() + 1))
    low, high = np.minimum.reduceat(corners, starts), np.maximum.reduceat(corners, starts)
    return (low + high) / 2, (high - low)[:, 2]


@per_case
def fastening_sets(case: Case) -> Float[np.ndarray, "k 3"]:
    """Return the middle of each fastening, that is, of the pieces that lie together, m."""
    return cluster_points(fastening_parts(case.candidate.track.fastening_mesh)[0], _SEAT_REACH)


def cluster_points(middle: Float[np.ndarray, "p 3"], reach: float) -> Float[np.ndarray, "k 3"]:
    """Return the mean of each group of points that hang together by steps of at most `reach`, m."""
    if not len(middle):
        return middle
    label = connected_groups(len(middle), cKDTree(middle).query_pairs(reach, output_type="ndarray"))
    weight = np.bincount(label)[:, None]
    return np.stack([np.bincount(label, column) for column in middle.T], axis=1) / weight


# Rail seats: overlaps and gaps, measured by vertical rays.

_HEAD_HALF = 0.0365  # m from a head's inner face to its middle
_RAY_START = 1.0  # m
_BED_ASIDE = 0.3  # m from the track's middle, where the bed is looked for


@per_case
def seat_mismatches(case: Case) -> Float[np.ndarray, " k"]:
    """Return overlaps (below 0) and gaps of pad on sleeper, rail on pad, and sleepers over the bed, m."""
    track, curve = case.candidate.track, candidate_curve(case)
    if not len(track.sleeper) or min(len(rail) for rail in track.rail.values()) < 2:
        raise ValueError("there is no track")
    sleepers, rails, pads = (Caster(m) for m in (track.sleeper_mesh, track.rail_mesh, track.fastening_mesh))
    at = curve.local(track.sleeper)
    _, _, left, up = curve.frames(at[:, 0])
    gaps = []
    for rail in track.rail.values():
        face = curve.local(rail)
        face = face[np.argsort(face[:, 0])]
        inner = np.interp(at[:, 0], face[:, 0], face[:, 1])
        across = inner + np.sign(inner - at[:, 1]) * _HEAD_HALF
        seat = track.sleeper + (across - at[:, 1])[:, None] * left
        top = _surface_level(sleepers, seat, up, above=True)
        pad = _surface_level(pads, seat, up, above=False), _surface_level(pads, seat, up, above=True)
        foot = _surface_level(rails, seat, up, above=False)
        gaps += [pad[0] - top, foot - np.where(np.isfinite(pad[1]), pad[1], top)]
    gaps.append(np.maximum(_hanging_gaps(case, sleepers, track.sleeper, left, up), 0.0))
    every = np.concatenate(gaps)
    return every[np.isfinite(every)]


def _surface_level(caster: Caster, at: np.ndarray, up: np.ndarray, above: bool) -> Float[np.ndarray, " k"]:
    """Return the height about `at` of the first surface met from far above or below, m; NaN for none."""
    sign = 1.0 if above else -1.0
    reach = caster.first(at + sign * _RAY_START * up, -sign * up)[0]
    return np.where(np.isfinite(reach), sign * (_RAY_START - reach), np.nan)


def _hanging_gaps(case: Case, sleepers: Caster, at: np.ndarray, left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the height of each sleeper's bottom above the bed, or of the bed above its top, m."""
    place = at + _BED_ASIDE * left
    # The slabs on which sleepers lie; a case in memory has no scene.
    slabs = [scene_geoms(case).joined("bed_")] if case.candidate.scene.exists() else []
    bed = Caster(concatenate_meshes([case.candidate.lining, *(slab for slab in slabs if len(slab.faces))]))
    # From just above the sleeper: the lining overhead is out of the way.
    level = 0.3 - bed.first(place + 0.3 * up, -up)[0]
    bottom, top = _surface_level(sleepers, place, up, above=False), _surface_level(sleepers, place, up, above=True)
    return np.maximum(bottom - level, level - top)
