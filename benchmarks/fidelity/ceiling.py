"""The truth as a candidate: what a perfect reconstruction scores, and so where thresholds can be met."""

from dataclasses import replace

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.compiled import Track
from benchmarks.fidelity.controls.parts import without_faces
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.surface import Caster
from benchmarks.fidelity.references import Truth

WALL = ("lining", "joint", "floor", "pocket")
ANGLES = 360
_POCKET = np.dtype(
    [(name, float) for name in ("station", "angle", "length", "width", "depth", "confidence")] + [("measured", bool)]
)


def truth_candidate(truth: Truth, base: Candidate) -> Candidate:
    """The true surface in the place of a reconstruction; its compiled scene stays the base's.

    Args:
        truth: Of the simulated survey.
        base: Whose scene folder and names are kept.
    """
    wall = part(truth, WALL)
    wall.merge_vertices(digits_vertex=6)
    return replace(
        base, name="truth", lining=wall, solid=capped(wall), bore=_bore(truth), track=_track(truth, base.track),
        nails=part(truth, ("nail",)), bed=trimesh.Trimesh(),
    )  # fmt: skip


def part(truth: Truth, names: tuple[str, ...]) -> trimesh.Trimesh:
    """The faces of some parts of the true surface."""
    wanted = [truth.parts.index(name) for name in names if name in truth.parts]
    return without_faces(truth.surface, ~np.isin(truth.part, wanted))


def capped(lining: trimesh.Trimesh) -> trimesh.Trimesh:
    """The open surface, wound alike everywhere, with each rim closed by a fan that is wound as it is."""
    _, first, count = np.unique(lining.edges_sorted, axis=0, return_index=True, return_counts=True)
    rim = lining.edges[first[count == 1]]
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


def _bore(truth: Truth) -> Bore:
    curve = Curve(truth.station, truth.position)
    position, tangent, left, up = curve.frames(truth.station)
    angle = np.linspace(-np.pi, np.pi, ANGLES, endpoint=False) + np.pi / ANGLES
    away = np.cos(angle)[None, :, None] * left[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    origin = np.repeat(position[:, None], ANGLES, axis=1)
    reach, _ = Caster(part(truth, WALL)).first(origin.reshape(-1, 3), away.reshape(-1, 3))
    radius = reach.reshape(len(position), ANGLES)
    median = np.nanmedian(np.where(np.isfinite(radius), radius, np.nan), axis=0)
    radius = np.where(np.isfinite(radius), radius, median)
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


def _track(truth: Truth, base: Track) -> Track:
    sleepers, rails = truth.furniture.get("sleepers", {}), truth.furniture.get("rails", {})
    if not sleepers or not rails:
        return base
    heads = {side: np.asarray(rails[side], float).reshape(-1, 3) - truth.origin for side in ("left", "right")}
    gauge = float(rails["gauge"])
    aside = float(rails["axis_offset"]) - 0.5 * gauge
    curve = Curve(truth.station, truth.position)
    inner = {side: _inward(points, curve, aside) for side, points in heads.items()}
    return Track(
        np.asarray(sleepers["position"], float).reshape(-1, 3) - truth.origin, part(truth, ("sleeper",)), inner,
        part(truth, ("rail",)), part(truth, ("fastening",)), gauge,
    )  # fmt: skip


def _inward(points: np.ndarray, curve: Curve, by: float) -> np.ndarray:
    local = curve.local(points)
    local[:, 1] -= by * np.sign(local[:, 1])
    return curve.point(local)
