"""The variant `furnished`: the bore with niches for cross-passages, furniture, and what a planar LiDAR sees of it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.bore import POCKET, Bore
from scene.writing.furniture import FurnitureConfig, Piece, TunnelSpace, place_furniture
from scene.writing.track import Track
from scene.writing.unrolled import recess_boxes, unroll_section
from scene.writing.walls import Opening

_DOOR = (1.2, 0.08, 2.0)  # length, thickness, height, m
_FRAME = 0.15  # of wall left between a niche and the next pocket, m
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])


@dataclass(frozen=True)
class Furnished:
    """A bore and what stands in it."""

    bore: Bore  # With the niches among its pockets, in place of the pockets they take away
    pieces: list[Piece]  # The furniture
    openings: list[Opening]  # Parts of the wall that niches take out
    niches: list[tuple[float, float]]  # First and last station of each niche, m
    niche_corners: list[Float[np.ndarray, "8 3"]]  # Corners of the air of each niche, m


def furnish_bore(bore: Bore, track: Track, config: FurnitureConfig) -> Furnished:
    """Adds niches and furniture by standard, as far as the bore has room for them."""
    openings = _niche_openings(bore, track, config) if config.passage else []
    niche = _niche_pockets(bore, openings, config.passage_size[2])
    spans = [(float(row["station"] - row["length"] / 2), float(row["station"] + row["length"] / 2)) for row in niche]
    keep = np.ones(len(bore.pocket), bool)
    for row in niche:
        keep &= ~_overlaps(bore, row)
    with_niches = replace(bore, pocket=np.concatenate([bore.pocket[keep], niche]))
    number = np.arange(keep.sum(), len(with_niches.pocket))
    corners = [_cut_flush(box) for box in recess_boxes(with_niches, number)]
    pieces = place_furniture(TunnelSpace(bore, track, config, spans)) + [_niche_door(corner) for corner in corners]
    return Furnished(with_niches, pieces, openings, spans, corners)


def planar_segments(
    pieces: list[Piece], bore: Bore, elevation: Float[np.ndarray, " n"], height: float
) -> Float[np.ndarray, "f 4"]:
    """Return outlines of the pieces where a surface `height` m above the track cuts them.

    They are segments `x0, y0, x1, y1`, m; those of one piece follow one another and close.
    """
    if not pieces:
        return np.empty((0, 4))
    corners = np.stack([piece.corners() for piece in pieces])
    station = bore.axis.local(corners.reshape(-1, 3))[0]
    level = corners[..., 2] - np.interp(station, bore.station, elevation).reshape(corners.shape[:2]) - height
    outlines = []
    for corner, over in zip(corners, level, strict=True):
        crossed = _EDGES[(over[_EDGES[:, 0]] < 0) != (over[_EDGES[:, 1]] < 0)]
        if not len(crossed):
            continue
        a, b = crossed.T
        share = over[a] / (over[a] - over[b])
        outline = corner[a, :2] + share[:, None] * (corner[b, :2] - corner[a, :2])
        offset = outline - outline.mean(axis=0)
        outline = outline[np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))]
        outlines.append(np.hstack([outline, np.roll(outline, -1, axis=0)]))
    return np.concatenate(outlines) if outlines else np.empty((0, 4))


def _niche_openings(bore: Bore, track: Track, config: FurnitureConfig) -> list[Opening]:
    """Niches on the grid of the bore, above the walkway (the sleepers, where there is none), on the left."""
    length, height, _ = config.passage_size
    step, openings = bore.station[1], []
    left = np.flatnonzero(np.cos(bore.angle) > 0.3)
    foot = config.walkway_height if config.walkway else 0.0
    for station in np.arange(config.passage_spacing / 2, bore.length - length, config.passage_spacing):
        first, last = round((station - length / 2) / step), round((station + length / 2) / step)
        middle = (first + last) // 2
        level = bore.surface()[middle, left, 2] - track.elevation[middle]
        low, high = (int(left[np.argmin(np.abs(level - z))]) for z in (foot, foot + height))
        if first > 1 and low != high:
            openings.append(Opening((first, last), (low, high)))
    return openings


def _niche_pockets(bore: Bore, openings: list[Opening], depth: float) -> np.ndarray:
    plane, rows = unroll_section(bore), []
    for opening in openings:
        first, last = bore.station[list(opening.rows)]
        low, high = np.sort(plane.to_around(bore.angle[list(opening.columns)]))
        angle = float(plane.to_angle((low + high) / 2))
        rows.append(((first + last) / 2, angle, last - first, high - low, depth, 1.0, False))
    return np.array(rows, POCKET) if rows else np.empty(0, POCKET)


def _overlaps(bore: Bore, niche: np.void) -> np.ndarray:
    """True for the pockets that a niche takes away."""
    plane, pocket = unroll_section(bore), bore.pocket
    across = np.abs(plane.to_around(pocket["angle"]) - plane.to_around(niche["angle"]))
    across = np.minimum(across, plane.girth - across)
    beside = np.abs(pocket["station"] - niche["station"]) < (pocket["length"] + niche["length"]) / 2 + _FRAME
    return beside & (across < (pocket["width"] + niche["width"]) / 2 + _FRAME)


def _niche_door(corners: Float[np.ndarray, "8 3"]) -> Piece:
    """Return the door at the back of a niche."""
    grid = corners.reshape(2, 2, 2, 3)
    x, z = grid[1, 0, 1] - grid[0, 0, 1], grid[0, 1, 1] - grid[0, 0, 1]
    half = np.array([min(_DOOR[0], np.linalg.norm(x)), _DOOR[1], min(_DOOR[2], np.linalg.norm(z))]) / 2
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    foot = (grid[0, 0, 1] + grid[1, 0, 1]) / 2
    inwards = grid[0, 0, 0] - grid[0, 0, 1]
    centre = foot + half[2] * z + half[1] * inwards / np.linalg.norm(inwards)
    return Piece(
        "passage_door", "door", centre, Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z])), half, True
    )


def _cut_flush(box: Float[np.ndarray, "8 3"]) -> Float[np.ndarray, "8 3"]:
    """Return a niche's box without the part that reaches into the bore, so that its front lies in the wall."""
    grid = box.reshape(4, 2, 3)
    inward = grid[:, 0] - grid[:, 1]
    size = np.linalg.norm(inward, axis=1, keepdims=True)
    return np.stack([grid[:, 1] + inward * (size - 0.05) / size, grid[:, 1]], axis=1).reshape(8, 3)
