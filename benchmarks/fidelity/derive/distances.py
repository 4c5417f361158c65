"""Held-out points against the candidate: distances both ways, M3C2, the self-cast check, occupied voxels."""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy import ndimage
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold
from benchmarks.fidelity.derive import beams, surface
from benchmarks.fidelity.derive.clouds import Planes, plane_rows, real_planes
from benchmarks.fidelity.derive.curve import candidate_curve
from benchmarks.fidelity.references import Hold

MOST_POINTS = 120_000
BOOTSTRAP_SAMPLES = 50_000  # samples behind an interval; the value itself uses all
STEEPEST = np.cos(np.deg2rad(80.0))  # beams that graze a surface at more than 80° do not observe it
_MESH_CELL = 0.1  # m between samples of the candidate
_AXIS_SECTORS = 8


@dataclass(frozen=True)
class MeshDistances:
    """Distances of held-out points to the candidate."""

    distance: Float[np.ndarray, " n"]  # Distance to the nearest point of the candidate, m
    signed: Float[np.ndarray, " n"]  # Distance, positive where the point is on the sensor's side of the surface, m
    station: Float[np.ndarray, " n"]  # Station along the sensor's path, m
    sector: Int[np.ndarray, " n"]  # One of eight about the candidate's axis: 0 to its left, 2 its crown, 6 its floor


@kept_until("DEG", per_hold)
def thinned_rows(case: Case) -> Int[np.ndarray, " k"]:
    """Return the numbers of at most `MOST_POINTS` returns, evenly spaced in time."""
    count = len(beams.returns(case).range)
    return np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(int)


@kept_until("CMP", per_case)
def mesh_distances(case: Case) -> MeshDistances:
    """Return the distances of held-out points to everything visible of the candidate, without registration."""
    pick, real = thinned_rows(case), beams.returns(case)
    points = real.points[pick]
    distance, closest, face = surface.surface_nearest(case).query(points)
    normal = surface.face_normals(surface.visible_surface(case), face)
    side = np.einsum("ij,ij->i", normal, points - closest) * np.einsum("ij,ij->i", normal, real.origin[pick] - closest)
    local = candidate_curve(case).local(points)
    sector = np.round(np.arctan2(local[:, 2], local[:, 1]) / (2.0 * np.pi / _AXIS_SECTORS)).astype(int) % _AXIS_SECTORS
    return MeshDistances(distance, np.copysign(distance, side), real.local[pick, 0], sector)


def mean_distance(case: Case, other: Hold) -> float:
    """Return the mean distance of another recording's points to the candidate, m."""
    pick = np.linspace(0, len(other.points) - 1, min(len(other.points), MOST_POINTS)).astype(int)
    return float(surface.surface_nearest(case).query(other.points[pick])[0].mean())


@per_case
def cloud_distances(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return distance to the nearest held-out point, and station along the sensor's path, of observed samples, m.

    Samples of the candidate, one in 10 cm, are those that a held-out beam cast in the candidate would have hit.
    A sample counts as observed if a beam hits the candidate within 5 cm of it at less than 80° of incidence; half the
    smallest tolerance, so that a return that is there is within reach of it.
    """
    cast = beams.cast_beams(case)
    observed = cast.cosine > STEEPEST
    hits = beams.points_at(case, cast.range)[observed]
    samples, _ = surface.sample_surface(surface.visible_surface(case), _MESH_CELL)
    samples = samples[:: max(len(samples) // (4 * MOST_POINTS), 1)]
    if not len(hits) or not len(samples):
        raise ValueError("no held-out beam meets the candidate")
    gap, _ = cKDTree(hits, balanced_tree=False).query(samples, distance_upper_bound=0.05)
    samples = samples[np.isfinite(gap)]
    local = beams.sensor_path(case).local(samples)
    # Small triangles have too many samples.
    even = np.unique(surface.cell_numbers(local, _MESH_CELL), return_index=True)[1]
    even = even[np.linspace(0, len(even) - 1, min(len(even), MOST_POINTS)).astype(int)]
    return beams.cloud_tree(case).query(samples[even])[0], local[even, 0]


# Cells of the surface that held-out beams pass through.

_OBSERVED_CELL = 0.1  # m
_EARLY = 0.15  # m


@per_case
def phantom_cells(case: Case) -> Bool[np.ndarray, " c"]:
    """Return True for each cell of observable surface if most beams that hit it came back from behind it.

    Cells of 10 cm stand for equal areas; beams at more than 80° of incidence do not count, for there a millimetre off
    the surface is centimetres along the beam. A beam passes through if its return lies over 15 cm behind the surface.
    """
    cast = beams.cast_beams(case)
    observed = cast.cosine > STEEPEST
    number = surface.cell_numbers(beams.local_at(case, cast.range)[observed], _OBSERVED_CELL)
    cell = np.unique(number, return_inverse=True)[1]
    crossed = np.bincount(cell, cast.difference[observed] < -_EARLY)
    return crossed > 0.5 * np.bincount(cell)


# The density-aware Chamfer distance.

ALPHA = 40.0  # 1/m
_THIN = 0.1  # m


def density_aware_chamfer(case: Case) -> float:
    """Return the density-aware Chamfer distance of held-out and synthetic points, one in 10 cm each; 0 to 1.

    Source: Wu et al. 2021, arXiv 2111.12702, eq. 6: ½ Σ over both of the mean of 1 - exp(-α d) / n, with n the
    number of points that share the nearest neighbour.
    """
    cast = beams.cast_beams(case)
    both = beams.returns(case).local, beams.local_at(case, cast.range)[cast.hit]
    clouds = [points[np.unique(surface.cell_numbers(points, _THIN), return_index=True)[1]] for points in both]
    return 0.5 * (_one_way(clouds[0], clouds[1]) + _one_way(clouds[1], clouds[0]))


def _one_way(points: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "m 3"]) -> float:
    distance, index = cKDTree(others).query(points)
    shared = np.bincount(index, minlength=len(others))[index]
    return float(np.mean(1.0 - np.exp(-ALPHA * distance) / shared))


# M3C2: distances along the normal between held-out and synthetic cloud, and their significance.

M3C2_CORES = 5000
M3C2_RADIUS = 0.15  # m, of the cylinder
# m along the normal, either way. py4dgeo cuts the cylinder into ⌈reach / radius⌉ slabs: an even number of them has a
# border at the core point, which rounding then counts 0, 1 or 2 times, by the kind of processor.
M3C2_REACH = 0.7
M3C2_REGISTRATION = 0.01  # m: what poses that are given to a centimetre leave between two clouds


@dataclass(frozen=True)
class M3C2Distances:
    """M3C2 at each core point that has both clouds in its cylinder."""

    significant: Float[np.ndarray, " n"]  # 1 where |distance| exceeds the level of detection, else 0
    distance: Float[np.ndarray, " n"]  # Signed distance, m
    station: Float[np.ndarray, " n"]  # Station along the sensor's path, m


@kept_until("DEG", per_hold)
def _held_epoch(case: Case) -> Any:
    """Return the held-out points about a whole-metre origin, whose tree is built once for all candidates."""
    import py4dgeo

    points = beams.returns(case).points
    return py4dgeo.Epoch(points - np.round(points.mean(axis=0)))


@per_case
def m3c2_distances(case: Case) -> M3C2Distances:
    """Computes M3C2 of held-out points against the candidate's points on the same beams.

    The candidate's points carry no noise; the level of detection is 1.96·√(s₁²/n₁ + s₂²/n₂) + registration, in which
    the registration error is the given poses' (`M3C2_REGISTRATION`).

    Source: Lague, Brodu, Leroux 2013, ISPRS J. Photogramm. 82; computed by py4dgeo.
    """
    import py4dgeo

    logging.getLogger("py4dgeo").setLevel(logging.WARNING)  # below that it writes a log into the working directory
    real, cast = beams.returns(case), beams.cast_beams(case)
    hit = cast.hit
    flat: Planes = real_planes(case)
    pick = np.linspace(0, len(flat.point) - 1, min(len(flat.point), M3C2_CORES)).astype(int)
    offset = np.round(real.points.mean(axis=0))
    clean = beams.points_at(case, cast.range)[hit]
    m3c2 = py4dgeo.M3C2(
        epochs=(_held_epoch(case), py4dgeo.Epoch(clean - offset)),
        corepoints=flat.point[pick] - offset,
        corepoint_normals=flat.normal[pick],
        cyl_radius=M3C2_RADIUS,
        max_distance=M3C2_REACH,
        registration_error=M3C2_REGISTRATION,
    )
    distance, uncertainty = m3c2.run()
    known = np.isfinite(distance)
    beyond = np.abs(distance[known]) > uncertainty["lodetection"][known]
    return M3C2Distances(beyond.astype(float), distance[known], real.local[plane_rows(case)][pick][known, 0])


# The comparison that cannot fail: a cloud cast in the candidate with noise, against the same candidate.

PAPER_SIGMA = 0.05  # m: the range noise that the paper states for its LiDAR
_MOST_SELF_CAST = 30_000


@per_case
def self_cast(case: Case) -> tuple[Float[np.ndarray, " n"], float]:
    """Casts a noisy cloud at the held-out beams and measures it against the same mesh; any mesh passes.

    Returns:
        Distances to the mesh, and the mean that noise alone gives on planes: σ·√(2/π)·mean|cos incidence|, m.
    """
    real, cast = beams.returns(case), beams.cast_beams(case)
    pick = thinned_rows(case)
    pick = pick[cast.hit[pick]]
    pick = pick[:: max(len(pick) // _MOST_SELF_CAST, 1)]
    reach = cast.range[pick] + PAPER_SIGMA * case.rng("selfcast").standard_normal(len(pick))
    distance, _, _ = surface.surface_nearest(case).query(real.origin[pick] + reach[:, None] * real.direction[pick])
    return distance, float(PAPER_SIGMA * np.sqrt(2.0 / np.pi) * np.mean(cast.cosine[pick]))


# Occupied voxels in station, left and up along the sensor's path.

VOXEL_EDGE = 0.20  # m
SHELL_VOXELS = 3  # voxels about either surface that count for kappa: 0.6 m
_FREE_LENGTH = 1.5  # m of a beam before its return that are known to be free
_BEAM_STEP = 0.1  # m between samples along it
_AROUND_PATH = 12.0  # m from the path; what lies farther is no tunnel
_FREE_RAYS = 150_000
_FEWEST_TOGETHER = 4  # points of two clouds in a cell that counts in any case


@dataclass(frozen=True)
class Occupied:
    """Points by voxel on one grid, axes station, left, up."""

    # Number of held-out points and of those of two noisy draws in the candidate, which differ in noise alone
    points: Shaped[np.ndarray, "3 i j k"]
    known: Bool[np.ndarray, "i j k"]  # Voxels that held-out beams show, or that hold one of the surfaces
    station: Float[np.ndarray, " i"]  # Station of the middle of each slice, m

    @property
    def real(self) -> Bool[np.ndarray, "i j k"]:
        """True for voxels with a held-out point."""
        return self.points[0] > 0

    @property
    def first(self) -> Bool[np.ndarray, "i j k"]:
        """True for voxels with a point of the first draw."""
        return self.points[1] > 0


@kept_until("OCC", per_case)
def occupied_voxels(case: Case) -> Occupied:
    """Return the voxels of held-out and synthetic points, and the known voxels near them."""
    locals_ = [beams.local_at(case, beams.noisy_ranges(case, draw)) for draw in ("first", "second")]
    clouds = [_count_points(local) for local in (beams.returns(case).local, *locals_)]
    both = np.concatenate([index for index, _ in clouds[:2]])
    low, high = both.min(axis=0) - SHELL_VOXELS - 1, both.max(axis=0) + SHELL_VOXELS + 2
    points = np.stack([_fill_grid(index, count, low, high) for index, count in clouds])
    free = free_voxels(case)
    known = (points[0] > 0) | (points[1] > 0) | (_fill_grid(free, np.ones(len(free), np.int32), low, high) > 0)
    return Occupied(points, known, (np.arange(low[0], high[0]) + 0.5) * VOXEL_EDGE)


@kept_until("DEG", per_hold)
def free_voxels(case: Case) -> Int[np.ndarray, "n 3"]:
    """Return the indices of voxels that held-out beams passed in the last metres before their returns."""
    real = beams.returns(case)
    pick = np.linspace(0, len(real.range) - 1, min(len(real.range), _FREE_RAYS)).astype(int)
    before = np.arange(VOXEL_EDGE, _FREE_LENGTH, _BEAM_STEP)
    steps = (real.local[pick] - back * real.heading[pick] for back in before)
    return np.unique(np.concatenate([_count_points(step)[0] for step in steps]), axis=0)


def dilate(grid: Bool[np.ndarray, "..."], by: int = 1) -> Bool[np.ndarray, "..."]:
    return ndimage.maximum_filter(grid.astype(np.uint8), 2 * by + 1, mode="constant").astype(bool)


def cells_apart(a: Int[np.ndarray, "..."], b: Int[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return the cells that tell two clouds apart, from the number of points of each.

    Whether a surface that just cuts a cell has a point there is a matter of how many beams there are, and no point of
    the other cloud says little. So a cell with few points of both counts only where the other cloud has none beside it.
    """
    alone = ((a > 0) & ~dilate(b > 0)) | ((b > 0) & ~dilate(a > 0))
    return alone | (a + b >= _FEWEST_TOGETHER)


def both_apart(
    a: Int[np.ndarray, "..."], b: Int[np.ndarray, "..."]
) -> tuple[Bool[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """Return where either cloud has a point, among the cells that tell them apart."""
    apart = cells_apart(a, b)
    return (a > 0) & apart, (b > 0) & apart


def shell_voxels(grids: Occupied) -> Bool[np.ndarray, "i j k"]:
    """Return the known voxels within `SHELL_VOXELS` of either surface that are free in both or tell them apart."""
    real, first = grids.points[:2]
    apart = (real + first == 0) | cells_apart(real, first)
    return grids.known & apart & dilate(grids.real | grids.first, SHELL_VOXELS)


def iou(a: Bool[np.ndarray, "..."], b: Bool[np.ndarray, "..."]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def tolerant_f1(grids: Occupied, group: Int[np.ndarray, " i"]) -> Float[np.ndarray, " g"]:
    """Return F1 with a tolerance of one voxel for each group of slices; 0 where one of the surfaces is absent."""
    near = (grids.real & dilate(grids.first), grids.first & dilate(grids.real))
    counts = [np.bincount(group, grid.sum(axis=(1, 2))) for grid in (grids.real, grids.first, *near)]
    recall, precision = counts[2] / np.maximum(counts[0], 1), counts[3] / np.maximum(counts[1], 1)
    return 2.0 * precision * recall / np.maximum(precision + recall, 1e-12)


def _count_points(local: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, "v 3"], Int[np.ndarray, " v"]]:
    """Return the voxels with a point near the path, and the number of their points."""
    near = local[(np.abs(local[:, 1:]) < _AROUND_PATH).all(axis=1)]
    _, first, count = np.unique(surface.cell_numbers(near, VOXEL_EDGE), return_index=True, return_counts=True)
    return np.floor(near[first] / VOXEL_EDGE).astype(np.int64), count


def _fill_grid(
    index: Int[np.ndarray, "v 3"], count: Int[np.ndarray, " v"], low: Int[np.ndarray, "3"], high: Int[np.ndarray, "3"]
) -> Int[np.ndarray, "i j k"]:
    grid = np.zeros(tuple(high - low), np.int32)
    inside = ((index >= low) & (index < high)).all(axis=1)
    grid[tuple((index[inside] - low).T)] = count[inside]
    return grid
