"""The variant `furnished`: the bore with niches for cross-passages, furniture, and what a planar LiDAR sees of it.

Furniture is by standard, beside the track of a running tunnel, as boxes that fit the local bore. None of it is read
from the survey; each kind can be left out, since each is a landmark along the axis.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.bore import POCKET, Bore
from scene.writing.markup import rotation_along
from scene.writing.track import Track, wall_offset
from scene.writing.walls import Opening

_ROBOT_HEIGHT = 1.0  # m: what begins lower a robot may run into
_ASIDE = 0.3  # m: a third rail by standard belongs to a track on the axis


@dataclass(frozen=True)
class FurnitureConfig:
    """Kinds of furniture and their sizes, m; heights are above the top of the sleepers.

    Sources: widths of walkways 0.8 m (low) to 1.0 m: metro walkway descriptions; cross-passages 244 m apart: NFPA 130.
    Bracket pitch and tiers, the third rail's offset, plate pitch and all other sizes are engineering defaults.
    """

    walkway: bool = True  # Low walkway, on the left.
    # Width of the walkway; less where it would come within 5 cm of the sleepers, no walkway below 0.5 m.
    walkway_width: float = 0.8
    walkway_height: float = 0.30  # Height of the walkway's top.
    handrail: bool = True  # Handrail on posts along the walkway's wall.
    handrail_height: float = 1.0  # Height of the handrail above the walkway.
    post_spacing: float = 2.0  # Spacing of the handrail's posts.
    post_size: float = 0.05  # Side of a post's square section.
    cables: bool = True  # Cables on brackets along the right wall.
    bracket_spacing: float = 1.0  # Spacing of the brackets.
    bracket_length: float = 0.25  # Length of a bracket out of the wall.
    tiers: tuple[float, ...] = (0.55, 0.90, 1.25, 1.60)  # Heights of the brackets' arms.
    cable_diameter: float = 0.06  # Diameter of each tier's bundle.
    third_rail: bool = True  # Third rail, on the right.
    third_rail_offset: float = 0.7  # Distance from the running rail, middle to middle.
    plates: bool = True  # Hectometre plates on the left wall.
    plate_spacing: float = 100.0  # Spacing of the plates.
    passage: bool = True  # Doors of cross-passages, in niches of the left wall.
    passage_spacing: float = 244.0  # Spacing of the doors; the first stands half of it from the start.
    passage_size: tuple[float, float, float] = (2.0, 2.1, 0.5)  # Length, height and depth of a niche.
    lamps: bool = True  # Lamps at the crown.
    lamp_spacing: float = 12.0  # Spacing of the lamps.
    gauge: float = 0.9  # Half the width about the axis that nothing may enter up to a robot's height.


@dataclass(frozen=True)
class Item:
    """One box of furniture."""

    kind: str  # Kind of furniture
    material: str  # Material of the scene
    centre: Float[np.ndarray, "3"]  # m
    rotation: Rotation  # X along the bore, y to the left, z upwards
    half: Float[np.ndarray, "3"]  # Half its sizes, m
    low: bool  # True where a robot could run into it

    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Return the corners, m; the last bit of a corner's number tells lower from upper."""
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return self.centre + self.rotation.apply(signs * self.half)


@dataclass(frozen=True, eq=False)
class TunnelSpace:
    """The room in the tunnel for furniture."""

    bore: Bore  # The bore
    track: Track  # Its track
    config: FurnitureConfig  # Furniture to place
    # First and last station of each niche of the left wall, m
    keep_out: list[tuple[float, float]] = field(default_factory=list)

    def wall(self, start: float, end: float, height: float, side: int) -> tuple[float, float]:
        """Return nearest and furthest distance of the wall from the axis at a height over the sleepers, m."""
        offset = self._offset(height, side)
        step = self.bore.station[1]
        near = offset[int(start / step) : int(np.ceil(end / step)) + 1]
        return float(near.min()), float(near.max())

    @property
    def track_reach(self) -> float:
        """Largest distance of the middle of a track from the axis, m."""
        return max((float(np.abs(line.offset).max()) for line in self.track.lines), default=0.0)

    @lru_cache(maxsize=64)  # noqa: B019 a place lives as long as it is furnished
    def _offset(self, height: float, side: int) -> Float[np.ndarray, " n"]:
        return wall_offset(self.bore, self.track.elevation + height - self.bore.position[:, 2], side)

    def barred(self, start: float, end: float) -> bool:
        """Return whether a niche of the left wall lies in a stretch."""
        return any(start < last + 0.1 and first - 0.1 < end for first, last in self.keep_out)

    def box(
        self, kind: str, material: str, span: tuple[float, float], across: tuple[float, float], up: tuple[float, float]
    ) -> Item:
        """Return a box between two stations, two distances left of the axis and two heights over the sleepers, m."""
        line = (self.bore.position[:, 0], self.bore.position[:, 1], self.track.elevation)
        foot = np.column_stack([np.interp(span, self.bore.station, values) for values in line])
        rotation = rotation_along(foot[0], foot[1])
        middle = foot.mean(axis=0) + rotation.apply([0, sum(across) / 2, sum(up) / 2])
        half = np.array([np.linalg.norm(foot[1] - foot[0]), across[1] - across[0], up[1] - up[0]]) / 2
        return Item(kind, material, middle, rotation, half, low=up[0] < _ROBOT_HEIGHT)


def place_furniture(space: TunnelSpace) -> list[Item]:
    """Places everything that the configuration asks for and the bore has room for."""
    config = space.config
    items: list[Item] = []
    if config.walkway:
        items += _walkway(space)
    if config.cables:
        items += _cables(space)
    if config.third_rail and len(space.track.sleeper_station) and space.track_reach < _ASIDE:
        items += _third_rail(space)
    if config.plates:
        items += _plates(space)
    if config.lamps:
        items += _lamps(space)
    return items


def count_items(items: list[Item]) -> dict[str, int]:
    """Counts the boxes of each kind."""
    return dict(sorted(Counter(item.kind for item in items).items()))


def _stations(space: TunnelSpace, spacing: float, margin: float = 0.3) -> Float[np.ndarray, " k"]:
    return np.arange(spacing / 2, space.bore.length - margin, spacing)


def _stretches(space: TunnelSpace, spacing: float) -> list[tuple[float, float]]:
    edge = np.append(np.arange(0.0, space.bore.length - spacing / 2, spacing), space.bore.length)
    return list(zip(edge[:-1].tolist(), edge[1:].tolist(), strict=True))


def _walkway(space: TunnelSpace) -> list[Item]:
    config, items = space.config, []
    laid = bool(len(space.track.sleeper_station))
    aside = space.track_reach if space.track_reach > _ASIDE else 0.0
    least = max(config.gauge, aside + space.track.config.sleeper_length / 2 + 0.05)
    foot, top = -space.track.config.protrusion if laid else 0.0, config.walkway_height
    rail, half = top + config.handrail_height, config.post_size / 2
    for start, end in _stretches(space, config.post_spacing):
        near, far = space.wall(start, end, top, 1)
        inner = max(near - config.walkway_width, least)
        if near - inner < 0.5:
            continue
        items.append(space.box("walkway", "concrete_slab", (start, end), (inner, far + 0.02), (foot, top)))
        wall = min(space.wall(start, end, height, 1)[0] for height in (top, (top + rail) / 2, rail)) - 0.12
        if not config.handrail or space.barred(start, end):
            continue
        middle = (start + end) / 2
        span = (middle - half, middle + half)
        items.append(space.box("handrail_post", "galvanised", span, (wall - half, wall + half), (top, rail)))
        tube = (wall - 0.02, wall + 0.02)
        items.append(space.box("handrail", "galvanised", (start, end), tube, (rail - 0.04, rail)))
    return items


def _cables(space: TunnelSpace) -> list[Item]:
    config, items = space.config, []
    low, high = min(config.tiers) - 0.1, max(config.tiers) + 0.15
    # An arm begins at the wall at its own height: a wall that is dented there is the nearest.
    heights = (*np.linspace(low, high, 5), *config.tiers)
    for station in _stations(space, config.bracket_spacing):
        span = (station - 0.025, station + 0.025)
        near = min(space.wall(station, station, height, -1)[0] for height in heights)
        if near - config.bracket_length < config.gauge:
            continue
        items.append(space.box("bracket", "galvanised", span, (-near, -near + 0.05), (low, high)))
        for tier in config.tiers:
            far = space.wall(station, station, tier, -1)[1]
            arm = (-far, -near + config.bracket_length)
            items.append(space.box("bracket_arm", "galvanised", span, arm, (tier - 0.04, tier)))
    for start, end in _stretches(space, 2 * config.bracket_spacing):
        near = min(space.wall(start, end, height, -1)[0] for height in heights)
        if near - config.bracket_length < config.gauge:
            continue
        middle, half = -near + config.bracket_length / 2, config.cable_diameter / 2
        for tier in config.tiers:
            across = (middle - 2 * half, middle + 2 * half)
            items.append(space.box("cable", "cable", (start, end + 0.02), across, (tier, tier + 2 * half)))
    return items


def _third_rail(space: TunnelSpace) -> list[Item]:
    config, track, items = space.config, space.track.config, []
    middle = -(track.rail_offset + config.third_rail_offset)
    top = track.pad_thickness + track.rail.height + 0.076
    for start, end in _stretches(space, 3.0):
        if space.wall(start, end, top, -1)[0] < -middle + 0.15 or -middle - 0.1 < config.gauge:
            continue
        rail, pot, cover = ((middle - half, middle + half) for half in (0.04, 0.05, 0.08))
        span = (start + 0.5 - 0.05, start + 0.5 + 0.05)
        items.append(space.box("third_rail", "galvanised", (start, end + 0.02), rail, (top - 0.1, top)))
        items.append(space.box("insulator", "insulator", span, pot, (-track.protrusion, top - 0.1)))
        items.append(space.box("third_rail_cover", "cover", (start, end), cover, (top + 0.05, top + 0.07)))
    return items


def _plates(space: TunnelSpace) -> list[Item]:
    items = []
    for station in np.arange(space.config.plate_spacing, space.bore.length - 0.5, space.config.plate_spacing):
        if space.barred(station - 0.3, station + 0.3):
            continue
        near = min(space.wall(station - 0.25, station + 0.25, height, 1)[0] for height in (1.65, 1.95))
        span = (station - 0.25, station + 0.25)
        items.append(space.box("hectometre_plate", "plate", span, (near - 0.03, near), (1.65, 1.95)))
    return items


def _lamps(space: TunnelSpace) -> list[Item]:
    items, bore = [], space.bore
    crown = bore.toward(np.pi / 2)
    ceiling = bore.position[:, 2] + crown * bore.up[:, 2] - space.track.elevation
    for station in _stations(space, space.config.lamp_spacing):
        height = float(np.interp(station, bore.station, ceiling))
        span = (station - 0.6, station + 0.6)
        items.append(space.box("lamp", "lamp", span, (-0.09, 0.09), (height - 0.14, height - 0.04)))
    return items


_DOOR = (1.2, 0.08, 2.0)  # length, thickness, height, m
_FRAME = 0.15  # of wall left between a niche and the next pocket, m
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])


@dataclass(frozen=True)
class Furnished:
    """A bore and what stands in it."""

    bore: Bore  # With the niches among its pockets, in place of the pockets they take away
    items: list[Item]  # The furniture
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
    corners = [_cut_flush(box) for box in with_niches.recess_boxes(number)]
    items = place_furniture(TunnelSpace(bore, track, config, spans)) + [_niche_door(corner) for corner in corners]
    return Furnished(with_niches, items, openings, spans, corners)


def planar_segments(
    items: list[Item], bore: Bore, elevation: Float[np.ndarray, " n"], height: float
) -> Float[np.ndarray, "f 4"]:
    """Return outlines of the items where a surface `height` m above the track cuts them.

    They are segments `x0, y0, x1, y1`, m; those of one item follow one another and close.
    """
    if not items:
        return np.empty((0, 4))
    corners = np.stack([item.corners() for item in items])
    station = bore.axis.local(corners.reshape(-1, 3))[0]
    level = corners[..., 2] - np.interp(station, bore.station, elevation).reshape(corners.shape[:2]) - height
    outlines = []
    for corner, over in zip(corners, level, strict=True):
        crossed = _EDGES[(over[_EDGES[:, 0]] < 0) != (over[_EDGES[:, 1]] < 0)]
        if not len(crossed):
            continue
        a, b = crossed.T
        fraction = over[a] / (over[a] - over[b])
        outline = corner[a, :2] + fraction[:, None] * (corner[b, :2] - corner[a, :2])
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
    plane, rows = bore.unrolled(), []
    for opening in openings:
        first, last = bore.station[list(opening.rows)]
        low, high = np.sort(plane.to_around(bore.angle[list(opening.columns)]))
        angle = float(plane.to_angle((low + high) / 2))
        rows.append(((first + last) / 2, angle, last - first, high - low, depth, 1.0, False))
    return np.array(rows, POCKET) if rows else np.empty(0, POCKET)


def _overlaps(bore: Bore, niche: np.void) -> np.ndarray:
    """True for the pockets that a niche takes away."""
    plane, pocket = bore.unrolled(), bore.pocket
    across = np.abs(plane.to_around(pocket["angle"]) - plane.to_around(niche["angle"]))
    across = np.minimum(across, plane.girth - across)
    beside = np.abs(pocket["station"] - niche["station"]) < (pocket["length"] + niche["length"]) / 2 + _FRAME
    return beside & (across < (pocket["width"] + niche["width"]) / 2 + _FRAME)


def _niche_door(corners: Float[np.ndarray, "8 3"]) -> Item:
    grid = corners.reshape(2, 2, 2, 3)
    x, z = grid[1, 0, 1] - grid[0, 0, 1], grid[0, 1, 1] - grid[0, 0, 1]
    half = np.array([min(_DOOR[0], np.linalg.norm(x)), _DOOR[1], min(_DOOR[2], np.linalg.norm(z))]) / 2
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    foot = (grid[0, 0, 1] + grid[1, 0, 1]) / 2
    inwards = grid[0, 0, 0] - grid[0, 0, 1]
    centre = foot + half[2] * z + half[1] * inwards / np.linalg.norm(inwards)
    return Item(
        "passage_door", "door", centre, Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z])), half, True
    )


def _cut_flush(box: Float[np.ndarray, "8 3"]) -> Float[np.ndarray, "8 3"]:
    """Return a niche's box without the part that reaches into the bore, so that its front lies in the wall."""
    grid = box.reshape(4, 2, 3)
    inward = grid[:, 0] - grid[:, 1]
    size = np.linalg.norm(inward, axis=1, keepdims=True)
    return np.stack([grid[:, 1] + inward * (size - 0.05) / size, grid[:, 1]], axis=1).reshape(8, 3)
