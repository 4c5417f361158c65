"""Candidates for comparison: the null tube, which knows no detail, and the truth, which knows all."""

from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.candidate import Bore, Candidate, Track
from benchmarks.fidelity.derive.curve import Curve, cast_profile, interpolate_rows
from benchmarks.fidelity.derive.surface import Caster
from benchmarks.fidelity.meshes import count_edges
from benchmarks.fidelity.references import Truth

NULL_CORNERS = 72  # of the swept polygon
NULL_STEP = 0.5  # m between rings


def null_tube(candidate: Candidate, sleepers: bool = True) -> Candidate:
    """Return a candidate with the axis of the given one and its median section everywhere."""
    bore = candidate.bore
    count = max(round(candidate.length / NULL_STEP), 2) + 1
    station = np.linspace(bore.station[0], bore.station[-1], count)
    angle = np.linspace(-np.pi, np.pi, NULL_CORNERS, endpoint=False)
    radius = np.interp(angle, bore.angle, np.median(bore.radius, axis=0), period=2.0 * np.pi)
    frames = (bore.position, bore.lateral, bore.up)
    position, left, up = (interpolate_rows(station, bore.station, rows) for rows in frames)
    lining, solid = sweep_section(position, left, up, radius, angle)
    constant = replace(
        bore,
        width=np.full_like(bore.width, np.median(bore.width)),
        height=np.full_like(bore.height, np.median(bore.height)),
        radius=np.repeat(np.median(bore.radius, axis=0)[None], len(bore.station), axis=0),
        ring_station=bore.ring_station[:0],
        pocket=bore.pocket[:0],
    )
    none, rails = np.zeros((0, 3)), trimesh.Trimesh()
    track = candidate.track if sleepers else Track(none, rails, {"left": none, "right": none}, rails, rails)
    name = f"{candidate.name} as null tube" + ("" if sleepers else " without track")
    return replace(
        candidate, name=name, lining=lining, solid=solid, bore=constant, track=track, extra=trimesh.Trimesh(),
        nails=trimesh.Trimesh(), bed=candidate.bed if sleepers else trimesh.Trimesh(),
    )  # fmt: skip


def sweep_section(
    position: Float[np.ndarray, "n 3"],
    left: Float[np.ndarray, "n 3"],
    up: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, " m"],
    angle: Float[np.ndarray, " m"],
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Return lining (seen from inside) and solid (normals outward) of one polygon swept along frames."""
    around = radius[:, None] * np.cos(angle)[:, None], radius[:, None] * np.sin(angle)[:, None]
    vertices = position[:, None] + around[0][None] * left[:, None] + around[1][None] * up[:, None]
    rings, corners = vertices.shape[:2]
    here = np.arange(rings - 1)[:, None] * corners + np.arange(corners)[None]
    beside = np.arange(rings - 1)[:, None] * corners + (np.arange(corners) + 1)[None] % corners
    inward = np.concatenate([
        np.stack([here, here + corners, beside], axis=-1).reshape(-1, 3),
        np.stack([beside, here + corners, beside + corners], axis=-1).reshape(-1, 3),
    ])  # fmt: skip
    flat = vertices.reshape(-1, 3)
    lining = trimesh.Trimesh(flat, inward, process=False)
    middle = len(flat)
    caps = [
        _fan(np.arange(corners), middle, reverse=True),
        _fan(np.arange(corners) + (rings - 1) * corners, middle + 1, reverse=False),
    ]
    outward = np.concatenate([inward[:, ::-1], *caps])
    solid = trimesh.Trimesh(np.vstack([flat, position[0], position[-1]]), outward, process=False)
    if solid.volume < 0.0:
        solid.faces, lining.faces = solid.faces[:, ::-1], lining.faces[:, ::-1]
    return lining, solid


def _fan(ring: np.ndarray, middle: int, reverse: bool) -> np.ndarray:
    fan = np.stack([np.full(len(ring), middle), ring, np.roll(ring, -1)], axis=1)
    return fan[:, ::-1] if reverse else fan


# The truth as a candidate: the score of a perfect reconstruction, and so where thresholds can be met.

WALL_PARTS = ("lining", "joint", "floor", "pocket")
BORE_ANGLES = 360
_POCKET = np.dtype(
    [(name, float) for name in ("station", "angle", "length", "width", "depth", "confidence")] + [("measured", bool)]
)


def truth_candidate(truth: Truth, base: Candidate) -> Candidate:
    """Return the true surface as a candidate; its compiled scene stays the base's."""
    wall = _true_mesh(truth, *WALL_PARTS)
    wall.merge_vertices(digits_vertex=6)
    return replace(
        base, name="truth", lining=wall, solid=cap_rims(wall), bore=_true_bore(truth),
        track=_true_track(truth, base.track), nails=_true_mesh(truth, "nail"), bed=trimesh.Trimesh(),
    )  # fmt: skip


def _true_mesh(truth: Truth, *names: str) -> trimesh.Trimesh:
    mesh = truth.faces(*names)
    mesh.remove_unreferenced_vertices()
    return mesh


def cap_rims(lining: trimesh.Trimesh) -> trimesh.Trimesh:
    """Closes each rim of an open surface with a fan that is wound like the surface."""
    _, count, edge = count_edges(lining)
    once = np.flatnonzero(count[edge] == 1)
    rim = lining.edges[once[np.argsort(edge[once])]]
    loops = trimesh.graph.connected_components(rim, min_len=3)
    vertices, faces = [np.asarray(lining.vertices)], [np.asarray(lining.faces)]
    for number, loop in enumerate(loops):
        back = rim[np.isin(rim, loop).all(axis=1)][:, ::-1]  # the neighbour of a face runs its edge the other way
        vertices.append(lining.vertices[loop].mean(axis=0)[None])
        faces.append(np.column_stack([back, np.full(len(back), len(lining.vertices) + number)]))
    solid = trimesh.Trimesh(np.vstack(vertices), np.vstack(faces), process=False)
    if solid.volume < 0.0:
        solid.invert()
    return solid


def _true_bore(truth: Truth) -> Bore:
    curve = Curve(truth.station, truth.position)
    position, tangent, left, up = curve.frames(truth.station)
    angle = np.linspace(-np.pi, np.pi, BORE_ANGLES, endpoint=False) + np.pi / BORE_ANGLES
    radius = cast_profile(Caster(_true_mesh(truth, *WALL_PARTS)), curve, truth.station, angle)
    radius = np.where(np.isfinite(radius), radius, np.nanmedian(radius, axis=0))
    rows = [
        (p["station"], p["angle"], p["length"], p["width"], p["depth"], 1.0, True)
        for p in truth.furniture.get("pockets", [])
        if p.get("open", True)
    ]
    joints = np.asarray(truth.furniture.get("rings", {}).get("station", []), float)
    return Bore(
        truth.station, position, tangent, left, up, truth.width, truth.height, angle, radius, joints,
        np.array(rows, _POCKET),
    )  # fmt: skip


def _true_track(truth: Truth, base: Track) -> Track:
    sleepers, rails = truth.furniture.get("sleepers", {}), truth.furniture.get("rails", {})
    if not sleepers or not rails:
        return base
    heads = {side: np.asarray(rails[side], float).reshape(-1, 3) - truth.origin for side in ("left", "right")}
    gauge = float(rails["gauge"])
    aside = float(rails["axis_offset"]) - 0.5 * gauge
    curve = Curve(truth.station, truth.position)
    inner = {side: _move_inward(points, curve, aside) for side, points in heads.items()}
    return Track(
        np.asarray(sleepers["position"], float).reshape(-1, 3) - truth.origin, _true_mesh(truth, "sleeper"), inner,
        _true_mesh(truth, "rail"), _true_mesh(truth, "fastening"),
    )  # fmt: skip


def _move_inward(points: np.ndarray, curve: Curve, by: float) -> np.ndarray:
    local = curve.local(points)
    local[:, 1] -= by * np.sign(local[:, 1])
    return curve.point(local)
