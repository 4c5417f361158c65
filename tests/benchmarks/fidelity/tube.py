"""A tube whose every dimension is known, as candidate, truth and held-out recording; what is corrupted is `replace`d.

`case(Tube(), replace(Tube(), width=5.7))` judges a tube 10 cm too wide against the right one.
"""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Bore, Candidate, Track
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.meshes import concatenate_meshes
from benchmarks.fidelity.references import PARTS, Hold, Truth
from scene.inputs import MANIFEST_SCHEMA
from tests.benchmarks.fidelity.tubemesh import rolled
from tests.benchmarks.fidelity.tubeshape import Tube


@cache
def surfaces(tube: Tube) -> tuple[trimesh.Trimesh, trimesh.Trimesh, np.ndarray]:
    """Lining, solid, and the part of each face of the lining."""
    return rolled(tube, tube.section)


@cache
def track(tube: Tube) -> Track:
    """Sleepers 2.5 m long, rails of three boxes a stretch, pads."""
    top = tube.floor(tube.sleepers) + tube.rise
    sleepers = [box(tube, s, 0.0, z - 0.105, (0.2, 2.5, 0.21)) for s, z in zip(tube.sleepers, top, strict=True)]
    rails, fastenings, rail = [], [], {"left": [], "right": []}
    offset = (tube.gauge + 0.073) / 2
    ends = np.linspace(0.0, tube.length, int(tube.length / 1.5) + 1) if tube.track else np.empty(0)
    for side, name in ((1, "left"), (-1, "right")):
        for a, b in pairwise(ends):
            base = tube.floor((a + b) / 2) + tube.rise + 0.01
            for width, low, high in ((0.15, 0.0, 0.012), (0.0165, 0.012, 0.1275), (0.073, 0.1275, 0.176)):
                middle, size = base + (low + high) / 2, (b - a, width, high - low)
                rails.append(box(tube, (a + b) / 2, side * offset, middle, size))
            inner = side * (offset - 0.0365)
            for end in (-(b - a) / 2, (b - a) / 2):
                point = tube.point((a + b) / 2, inner, base + 0.176)[0] + end * tube.frames((a + b) / 2)[1][0]
                rail[name].append(point)
        for s, z in zip(tube.sleepers, top, strict=True):
            fastenings.append(box(tube, s, side * offset, z + 0.005, (0.18, 0.15, 0.01)))
    points = {name: np.asarray(ends).reshape(-1, 3) for name, ends in rail.items()}
    tops = tube.point(tube.sleepers, np.zeros(len(tube.sleepers)), top).reshape(-1, 3)
    meshes = [concatenate_meshes(parts) for parts in (sleepers, rails, fastenings)]
    return Track(tops, meshes[0], points, meshes[1], meshes[2])


def box(tube: Tube, station: float, left: float, up: float, size: tuple[float, ...]) -> trimesh.Trimesh:
    """A box along the tube."""
    placement = np.eye(4)
    placement[:3, :3] = np.column_stack([axis[0] for axis in tube.frames(station)[1:]])
    placement[:3, 3] = tube.point(station, left, up)[0]
    return trimesh.creation.box(size, transform=placement)


def candidate(tube: Tube | None = None, folder: Path = Path("no-scene")) -> Candidate:
    """The tube as a reconstruction; `tubescene.write` makes the scene that `folder` lacks."""
    tube = tube or Tube()
    station = np.linspace(0.0, tube.length, int(tube.length / 0.25) + 1)
    angle = np.linspace(0.0, 2 * np.pi, 240, endpoint=False)
    position, tangent, lateral, up = tube.frames(station)
    scale = tube.scale(station)
    bore = Bore(
        station, position, tangent, lateral, up, tube.width * scale, tube.height * scale, angle,
        scale[:, None] * tube.section.radius(angle), tube.joints, tube.pockets,
    )  # fmt: skip
    lining, solid, _ = surfaces(tube)
    n = len(tube.sleepers)
    manifest = {
        "schema": MANIFEST_SCHEMA,
        "name": "tube",
        "frame": {"origin": list(tube.origin)},
        "inputs": [],
        "count": {"sleepers": n, "rails": 2 * bool(n), "fasteners": 4 * n, "pockets": len(tube.pockets)},
        "track": {"gauge": tube.gauge, "protrusion": tube.rise},
    }
    scene, plan = folder / "scene.xml", folder / "tunnel.npz"
    return Candidate("tube", folder, lining.copy(), solid.copy(), bore, track(tube), manifest, scene, plan)


@cache
def truth(tube: Tube) -> Truth:
    """The tube as the truth of a simulated survey."""
    origin = np.asarray(tube.origin)
    station = np.linspace(0.0, tube.length, int(tube.length / 0.25) + 1)
    lining, _, part = surfaces(tube)
    laid = track(tube)
    meshes = [lining, laid.sleeper_mesh, laid.rail_mesh, laid.fastening_mesh]
    parts = [part, *(np.full(len(m.faces), PARTS.index(n)) for m, n in zip(meshes[1:], PARTS[5:], strict=True))]
    scale, s = tube.scale(station), tube.pockets["station"]
    s_top = tube.floor(station) + tube.rise + 0.186
    offset = (tube.gauge + 0.073) / 2
    furniture = {
        "rings": {"width": tube.pitch, "station": tube.joints.tolist()},
        "pockets": [
            {"station": float(p["station"]), "angle": float(p["angle"]), "length": 0.2, "width": 0.18,
             "depth": float(p["depth"]), "open": True, "nail": False, "position": at.tolist(),
             "side": "left" if np.cos(p["angle"]) > 0 else "right"}
            for p, at in zip(tube.pockets, _on_wall(tube, s, tube.pockets["angle"]) + origin, strict=True)
        ],
        "nails": {"diameter": 0.028, "depth": 0.06, "count": 0},
        "sleepers": {"station": tube.sleepers.tolist(), "position": (laid.sleeper + origin).tolist(),
                     "spacing": tube.spacing, "length": 2.5, "top_above_floor": tube.rise},
        "rails": {"gauge": tube.gauge, "axis_offset": offset, "top_above_floor": tube.rise + 0.186,
                  "left": (tube.point(station, np.full_like(station, offset), s_top) + origin).tolist(),
                  "right": (tube.point(station, np.full_like(station, -offset), s_top) + origin).tolist()},
    }  # fmt: skip
    position, tangent, *_ = tube.frames(station)
    return Truth(
        station, position, tangent, tube.width * scale, tube.height * scale, concatenate_meshes(meshes),
        np.concatenate(parts), PARTS, furniture if tube.track else {**furniture, "rails": {}}, origin,
    )  # fmt: skip


def _on_wall(tube: Tube, station: np.ndarray, angle: np.ndarray) -> np.ndarray:
    radius = tube.scale(station) * tube.section.radius(angle)
    return tube.point(station, radius * np.cos(angle), radius * np.sin(angle)).reshape(-1, 3)


@cache
def hold(tube: Tube, sigma: float = 0.02, beams: int = 6000, spacing: float = 1.0, seed: int = 0) -> Hold:
    """A recording of the tube: every metre one scan over the whole sphere, from 1.6 m above the floor."""
    rng, surface = np.random.default_rng(seed), truth(tube).surface
    stations = np.arange(0.5, tube.length - 0.4, spacing)
    eyes = tube.point(stations, np.full(len(stations), 0.15), tube.floor(stations) + 1.6)
    origin = np.repeat(eyes, beams, axis=0)
    direction = rng.normal(size=origin.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ray = trimesh.ray.ray_pyembree.RayMeshIntersector(surface, scale_to_box=False)
    where, index, _ = ray.intersects_location(origin, direction, multiple_hits=False)
    kept = np.argsort(index, kind="stable")
    index, where = index[kept], where[kept]
    reach = np.linalg.norm(where - origin[index], axis=1) + sigma * rng.normal(size=len(index))
    scan = index // beams
    time = 100.0 + scan * spacing + (index % beams) * 0.1 / beams
    return Hold(time, scan, origin[index], direction[index], reach, "tube", max(sigma, 1e-3), 100.0, f"tube {seed}")


def case(reference: Tube | None = None, judged: Tube | None = None, seed: int = 0, **hold_options) -> Case:
    """A tube judged against another; without a second one against itself, with held-out recording and truth."""
    reference = reference or Tube()
    return Case(candidate(judged or reference), hold(reference, **hold_options), None, truth(reference), seed)


def corrupted(good: Case, **changes) -> Case:
    """A case whose candidate differs in some fields; nothing computed of the good one is kept but the references."""
    return replace(good, candidate=replace(good.candidate, **changes), cache={})
