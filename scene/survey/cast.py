"""Rays against the true mesh, the echoes that come back, and the sweeps of a LiDAR along the walk."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32, UInt8

from scene.survey.alignment import MARGIN, Alignment
from scene.survey.carrier import Carried, Poses, rotate
from scene.survey.config import SensorErrors
from scene.survey.lidar import SCAN_PERIOD, Lidar, Sweep
from scene.survey.mesh import Mesh, Part
from scene.survey.section import Section
from subterra_jax.host.texture import brightness, wall_angle

_WINDOW = 60.0  # m of progress for which one scene serves
_REACH = 190.0  # m loaded ahead of it, and behind it for LiDARs that look back; the longest range of any


@dataclass(frozen=True)
class Hits:
    """The first surface on each ray."""

    distance: Float32[np.ndarray, "n"]  # m, infinite where nothing is hit
    cosine: Float32[np.ndarray, "n"]  # Cosine of incidence; negative on a surface hit from behind
    part: UInt8[np.ndarray, "n"]  # `Part` that is hit; meaningless where nothing is
    normal: Float32[np.ndarray, "n 3"]  # Unit normals, towards the air


@dataclass(frozen=True)
class Loaded:
    """The part of a mesh within range of a carrier."""

    scene: EmbreeScene  # Its triangles
    origin: Float[np.ndarray, "3"]  # Point that the coordinates in the scene are relative to, m
    part: UInt8[np.ndarray, "f"]  # `Part` of each triangle

    def cast(self, origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]) -> Hits:
        """Return the first surface on each ray, of an origin, m, and a unit direction in the survey frame."""
        direction = np.ascontiguousarray(direction, np.float32)
        hit = self.scene.run((origin - self.origin).astype(np.float32), direction, output=True)
        normal, met = hit["Ng"], hit["primID"] >= 0
        size = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        normal = normal / np.where(met, size, 1.0).astype(np.float32)[:, None]
        cosine = -np.einsum("ij,ij->i", normal, direction)
        distance = np.where(met, hit["tfar"], np.float32(np.inf))
        return Hits(distance, cosine, self.part[np.where(met, hit["primID"], 0)], normal)


class Caster:
    """Casts rays at the mesh, of which only the part within range is loaded.

    Embree computes in float32. Coordinates in a scene are therefore relative to a whole-metre point near the carrier,
    which keeps them within some 250 m and their rounding within 0.03 mm.
    """

    def __init__(self, mesh: Mesh, behind: float = 20.0) -> None:
        self._mesh = mesh
        self._behind = behind
        self._window: int | None = None

    def load(self, station: float, near: Float[np.ndarray, "3"]) -> Loaded:
        """Return what can be seen by a carrier at `station`, m, about `near`, m."""
        window = int(np.floor(station / _WINDOW))
        if window != self._window:
            begin, mesh, origin = window * _WINDOW, self._mesh, np.floor(near)
            chosen = (mesh.station >= begin - self._behind) & (mesh.station <= begin + _WINDOW + _REACH)
            used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
            scene = EmbreeScene(robust=True)
            vertices = (mesh.vertices[used] - origin).astype(np.float32)
            TriangleMesh(scene, vertices, faces.reshape(-1, 3).astype(np.int32))
            self._loaded, self._window = Loaded(scene, origin, mesh.part[chosen]), window
        return self._loaded


FADING = 0.5  # standard deviation of the logarithm of the echo (speckle)
REFLECTIVITY_NOISE = 0.05  # of a reported reflectivity
STEEPEST = 10.0  # tangent of the incidence angle beyond which the noise grows no more
EDGE_STEP = 0.03  # m between two surfaces from which on they make an edge
PULSE = 0.75  # m: echoes further apart in range are distinguished by the receiver; half a pulse of 5 ns

# Diffuse reflectivity at 905 nm by `Part`; engineering judgement, meant to tell materials apart.
ALBEDO = np.zeros(len(Part))
ALBEDO[[Part.LINING, Part.JOINT, Part.POCKET, Part.NAIL]] = 0.30, 0.15, 0.24, 0.45
ALBEDO[[Part.FLOOR, Part.SLEEPER, Part.RAIL, Part.FASTENING]] = 0.20, 0.36, 0.42, 0.28
ALBEDO[Part.THING] = 0.35


_NODE = 0.1  # m between the frames to which points are referred


class Face:
    """Brightness of the lining, fixed to the wall: factors on its reflectivity."""

    def __init__(self, alignment: Alignment, section: Section, texture: float, seed: int) -> None:
        self._section, self._texture, self._seed = section, texture, seed
        self._nodes = np.arange(-MARGIN, alignment.length + MARGIN, _NODE)
        self._frames = alignment.frames(self._nodes)

    def __call__(
        self, station: float, points: Float[np.ndarray, "n 3"], part: UInt8[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Return the factors of points on some parts, m in the survey frame, seen from about a station, m."""
        own = np.flatnonzero(np.isin(part, (Part.LINING, Part.JOINT, Part.POCKET, Part.FLOOR)))
        at, shown, frames = np.full(len(own), station), points[own], self._frames
        for _ in range(3):
            node = np.clip(np.rint((at + MARGIN) / _NODE).astype(int), 0, len(self._nodes) - 1)
            away = shown - frames.position[node]
            at = self._nodes[node] + np.einsum("ij,ij->i", away, frames.tangent[node])
        left = np.einsum("ij,ij->i", away, frames.lateral[node])
        above = np.einsum("ij,ij->i", away, frames.up[node]) + (0.5 * self._section.height(self._nodes))[node]
        factors = np.ones(len(part))
        factors[own] = brightness(np, at, wall_angle(np, left, above), self._seed, self._texture)
        return factors


def draw_returns(
    rng: np.random.Generator, lidar: Lidar, errors: SensorErrors, hits: Hits, factor: Any = 1.0
) -> Bool[np.ndarray, "n"]:
    """Draws which pulses come back.

    The echo is albedo · cos(incidence) / distance², faded by a log-normal factor; it returns if it exceeds the
    weakest that the LiDAR detects; `factor` is on the albedo. On a concrete wall beside the track that ends the Avia's
    view at about 60 to 70 m.
    A surface that is hit from behind never returns.
    """
    distance, cosine = hits.distance, hits.cosine
    seen = (distance >= lidar.range_min) & (distance <= lidar.range_max) & (cosine > 0.0)
    if errors.weak_echoes:
        echo = factor * ALBEDO[hits.part] * cosine * np.exp(FADING * rng.standard_normal(len(distance), np.float32))
        seen &= echo > lidar.weakest_echo * distance * distance
    return seen & (rng.random(len(distance), np.float32) >= errors.lost)


def noise_sigma(
    errors: SensorErrors, distance: Float32[np.ndarray, "n"], cosine: Float32[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return the standard deviation of ranges, m: constant, by range and by incidence, in quadrature."""
    slant = np.clip(cosine, 1e-3, 1.0)
    tangent = np.minimum(np.sqrt(1.0 - slant * slant) / slant, STEEPEST)
    reach = np.where(np.isfinite(distance), distance, 0.0)
    return np.sqrt(
        errors.range_noise**2 + (errors.range_noise_per_metre * reach) ** 2 + (errors.incidence_noise * tangent) ** 2
    )


def mix_pixels(
    rng: np.random.Generator,
    lidar: Lidar,
    fraction: float,
    loaded: Loaded,
    origin: Float[np.ndarray, "n 3"],
    heading: Float[np.ndarray, "n 3"],
    hits: Hits,
) -> Float32[np.ndarray, "n"]:
    """Return distances in which some beams across a depth edge fall between its two surfaces, m.

    A beam straddles an edge if a ray from its rim, to a drawn side, meets a surface more than `EDGE_STEP` off the
    plane that its middle meets, and less than `PULSE` further or nearer. Of those, `fraction` report a distance drawn
    evenly between the two. Rays are in the survey frame, m; `hits` is the first surface on the middle of each.
    """
    chosen = np.flatnonzero((rng.random(len(heading), np.float32) < fraction) & np.isfinite(hits.distance))
    ray, near, normal = heading[chosen], hits.distance[chosen], hits.normal[chosen]
    side = np.cross(ray, rng.standard_normal(ray.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    rim = np.cos(lidar.divergence) * ray + np.sin(lidar.divergence) * side
    other = loaded.cast(origin[chosen], rim).distance
    step = np.where(np.isfinite(other), other - near, np.inf)
    reach = np.where(np.isfinite(other), other, 0.0)
    off_plane = reach * np.einsum("ij,ij->i", normal, rim) - near * np.einsum("ij,ij->i", normal, ray)
    edge = (abs(step) < PULSE) & (abs(off_plane) > EDGE_STEP)
    distance = hits.distance.copy()
    distance[chosen] += np.where(edge, step, 0.0) * rng.random(len(step), np.float32)
    return distance


def draw_reflectivity(
    rng: np.random.Generator, cosine: Float32[np.ndarray, "n"], part: UInt8[np.ndarray, "n"], factor: Any = 1.0
) -> UInt8[np.ndarray, "n"]:
    """Draws reported reflectivity: 0 to 150 for 0 to 100 % diffuse, as Livox scales it, with 5 % noise."""
    value = (
        150.0 * factor * ALBEDO[part] * cosine * (1.0 + REFLECTIVITY_NOISE * rng.standard_normal(len(part), np.float32))
    )
    return np.clip(np.rint(value), 0, 255).astype(np.uint8)


DOPPLER_SIGMA = 0.03  # m/s. Source: Aeva's Aeries II, 3 cm/s
_INSTANT = 0.005  # s to either side, over which the sensor's speed is taken
_RAYS_AT_ONCE = 240_000  # large enough for numpy, small enough for the memory
_SECOND_RETURN = 0.02  # fraction of returns marked as second ones


def n_sweeps(carried: Carried, every: int) -> int:
    """Return the number of sweeps that `sweeps` yields."""
    return len(range(0, round(carried.walk.duration / SCAN_PERIOD), every))


# What floats between the LiDAR and the walls: from rays in the LiDAR's frame and what they hit to what they then hit.
Veil = Callable[[np.random.Generator, Float[np.ndarray, "n 3"], Hits], Hits]
Look = TypeVar("Look")


def _look_ahead(look: Callable[[np.ndarray], Look], batches: list[np.ndarray]) -> Iterator[Look]:
    """Yields what `look` returns for each batch; a second thread is one batch ahead: numpy and embree let it run."""
    with ThreadPoolExecutor(1) as second:
        coming = [second.submit(look, batch) for batch in batches[:1]]
        for following in [*batches[1:], None]:
            found = coming.pop().result()
            coming += [] if following is None else [second.submit(look, following)]
            yield found


def sweeps(
    rng: np.random.Generator,
    lidar: Lidar,
    carried: Carried,
    caster: Caster,
    errors: SensorErrors,
    every: int = 1,
    veil: Veil | None = None,
    face: Face | None = None,
    doppler: bool = False,
) -> Iterator[Sweep]:
    """Yields every `every`-th sweep in order of time; every point is cast from the pose at its own time.

    Without `distortion` in `errors`, all points of a sweep are measured at its stamp, and say so. A `veil` stands
    before every surface, as dust does. A `face` makes the lining brighter in places. `doppler` measures the speed of
    each range, positive away.
    """
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    offset = lidar.offset if errors.distortion else np.full_like(lidar.offset, lidar.stamp)
    numbers = np.arange(0, round(carried.walk.duration / SCAN_PERIOD), every)
    # Poses come from a table over all sweeps that are cast together, so these must follow each other.
    at_once = max(1, _RAYS_AT_ONCE // len(offset)) if every == 1 else 1
    n = len(offset)

    def look(batch: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Poses, float, Loaded, Hits]:
        begin = SCAN_PERIOD * batch
        ray = lidar.directions((begin[:, None] + 1e-9 * lidar.offset).ravel(), phase)
        poses = carried.poses_between(begin[0], (begin[:, None] + 1e-9 * offset).ravel())
        heading = rotate(poses.quaternion, ray)
        station = float(carried.walk.station(begin[:1])[0])
        loaded = caster.load(station, poses.position[0])
        return batch, ray, heading, poses, station, loaded, loaded.cast(poses.position, heading)

    batches = [numbers[first : first + at_once] for first in range(0, len(numbers), at_once)]
    for batch, ray, heading, poses, station, loaded, hits in _look_ahead(look, batches):
        if veil is not None:
            hits = veil(rng, ray, hits)

        factor: Any = 1.0
        if face is not None:
            ends = poses.position + np.where(np.isfinite(hits.distance), hits.distance, 0.0)[:, None] * heading
            factor = face(station, ends, hits.part)
        valid = draw_returns(rng, lidar, errors, hits, factor)
        distance = hits.distance
        if errors.mixed_pixels > 0.0:
            distance = mix_pixels(rng, lidar, errors.mixed_pixels, loaded, poses.position, heading, hits)
        sigma = noise_sigma(errors, distance, hits.cosine)
        # Rounded once, here: the cloud and the bag then hold the same point.
        seen = np.where(valid, distance + sigma * rng.standard_normal(len(ray), np.float32), 0.0).astype(np.float32)
        points = (seen[:, None] * ray).astype(np.float32)
        reflectivity = np.where(valid, draw_reflectivity(rng, hits.cosine, hits.part, factor), 0).astype(np.uint8)
        second = valid & (rng.random(len(ray), np.float32) < _SECOND_RETURN)
        velocity = None
        if doppler:
            begin = SCAN_PERIOD * batch
            times = (begin[:, None] + 1e-9 * offset).ravel()
            later, earlier = (carried.poses_between(begin[0] + t, times + t).position for t in (_INSTANT, -_INSTANT))
            closing = np.einsum("ij,ij->i", later - earlier, heading) / (2.0 * _INSTANT)
            noisy = DOPPLER_SIGMA * rng.standard_normal(len(ray)) - closing
            velocity = np.where(valid, noisy, 0.0).astype(np.float32)
        for k, number in enumerate(batch):
            of = slice(k * n, (k + 1) * n)
            yield Sweep(
                int(number), round(SCAN_PERIOD * 1e9) * int(number), offset, valid[of], points[of], reflectivity[of],
                second[of],
                None if velocity is None else velocity[of],
            )  # fmt: skip
