"""One bore in three dimensions, drawn: section, relief, pockets, niches and what stands at its walls.

Heights count from the floor, laterals to the left of the axis, which is the middle of the room at the sensor's height.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from subterra_jax.procedural.fixtures import Bench, Boxes, Mount, Section, draw_benches, draw_boxes, overlaps
from subterra_jax.procedural.kinds import Kind, PocketRanges
from subterra_jax.procedural.surfaces import Grid, Layer, Rings, draw_layers

N_ANGLES = 180
_END = 0.6  # ends of a tunnel without pockets and fixtures, m
_BETWEEN = 0.15  # least distance of two recesses, m


@dataclasses.dataclass(frozen=True)
class Bore:
    """A drawn bore; its wall is known on `grid`, bilinear in between."""

    kind: Kind  # its kind
    grid: Grid  # stations and angles about the axis at half the section's height
    middle: float  # height of that axis above the floor, m
    shift: float  # lateral of the lining's middle line, m
    section: Section  # design section
    outline: Float[np.ndarray, " m"]  # distance of the design wall from the axis, the floor left out, m, `(m,)`
    layers: list[Layer]  # relief of the wall
    rings: Rings | None  # its rings, if any
    # pockets of bolts: station and angle of the middle, length, width, depth, as in `ShellLining`, `(p, 5)`
    pocket: Float[np.ndarray, "p 5"]
    niche: Float[np.ndarray, "k 5"]  # niches that belong to the lining, in the same form
    recess: Float[np.ndarray, "r 5"]  # niches that are furniture, in the same form
    box: Boxes  # boxes that belong to the lining
    furniture: Boxes  # boxes that are furniture
    benches: tuple[Bench, ...]  # walkways and troughs, which are furniture
    mount: Mount  # place of the LiDAR

    @property
    def floor(self) -> Float[np.ndarray, " m"]:
        """Distance of the floor from the axis, m; `inf` upwards."""
        down = -np.sin(self.grid.angle)
        return np.where(down > 1e-9, self.middle / np.maximum(down, 1e-9), np.inf)

    def heights_of(self, recess: Float[np.ndarray, "p 5"]) -> Float[np.ndarray, " p"]:
        """Return the heights of the middles of recesses above the floor, m."""
        radius = np.interp(recess[:, 1], self.grid.angle, self.outline, period=2.0 * np.pi)
        return self.middle + radius * np.sin(recess[:, 1])

    def bench_edge(self, bench: Bench) -> float:
        """Return the distance of a bench's face from the axis, m."""
        return float(self.section.wall(bench.top)) - bench.width + bench.side * self.shift

    def bench_room(self) -> float:
        """Return the distance of the nearest bench in the plane of the planar LiDAR, m; `inf` where none is."""
        met = (bench for bench in self.benches if is_met(bench, self.mount, self.section))
        return min((self.bench_edge(bench) for bench in met), default=np.inf)

    def radius(self, columns: Int[np.ndarray, " c"] | None = None, smooth: bool = False) -> Float[np.ndarray, "n c"]:
        """Return distances of wall and floor from the axis at all stations and some angles, m; smooth has no relief."""
        columns = np.arange(N_ANGLES) if columns is None else columns
        wall = np.repeat(self.outline[None, columns], len(self.grid.station), axis=0)
        if not smooth:
            for layer in self.layers:
                wall = wall + layer.relief(self.grid, columns)
        return np.minimum(wall, self.floor[columns])


def draw_bore(kind: Kind, length: float, items: tuple[str, ...], seeds: list[np.random.Generator]) -> Bore:
    """Draw a bore.

    Args:
        length: Length, m.
        items: Furniture that it has.
        seeds: Random generators of section, surface, pockets, furniture and mount, so that none moves another.
    """
    section_rng, surface_rng, pocket_rng, furniture_rng, mount_rng = seeds
    section, mount = Section.draw(section_rng, kind.section), Mount.draw(mount_rng)
    benches = draw_benches(furniture_rng, items)
    # The robot keeps to the middle of the room that its LiDAR sees.
    shift = 0.5 * sum(bench.side * bench.width for bench in benches if is_met(bench, mount, section))
    grid, outline = _grid(section, shift, kind.step, length)
    bolts = int(section_rng.integers(kind.pockets.bolts[0], kind.pockets.bolts[1] + 1)) if kind.pockets else 1
    layers = draw_layers(surface_rng, kind, length, section.half_width, float(grid.girth.max()), bolts)
    rings = next((layer for layer in layers if isinstance(layer, Rings)), None)
    middle = 0.5 * section.height

    def niches(boxes: Boxes) -> Float[np.ndarray, "k 5"]:
        return _niches(boxes.where(boxes.out < 0.0), section, shift, middle)

    own = draw_boxes(furniture_rng, kind.always, section, shift, length)
    extra = draw_boxes(furniture_rng, tuple(i for i in items if i in kind.fixtures), section, shift, length, own)
    pocket = np.zeros((0, 5))
    if kind.pockets is not None and rings is not None:
        dowels = pocket_rng.random() < (kind.rings.dowel_fraction if kind.rings else 0.0)
        pocket = _bolt_pockets(pocket_rng, kind.pockets, rings, bolts, dowels, section, length)
        pocket = _about_axis(pocket, section, shift, middle)
        pocket = _clear_pockets(pocket, grid, outline, middle, [own, extra])
    return Bore(
        kind, grid, middle, shift, section, outline, layers, rings, pocket, niches(own), niches(extra),
        own.where(own.out > 0.0), extra.where(extra.out > 0.0), benches, mount,
    )  # fmt: skip


def is_met(bench: Bench, mount: Mount, section: Section) -> bool:
    """Return whether the plane of the planar LiDAR meets a bench."""
    return bool(mount.plane(bench.side * section.half_width) < bench.top)


def _grid(section: Section, shift: float, step: float, length: float) -> tuple[Grid, Float[np.ndarray, " m"]]:
    """Return the grid about the axis, and the distance of the design wall from it, m."""
    angle = 2.0 * np.pi / N_ANGLES * np.arange(N_ANGLES)
    x, z = section.outline[:, 0] + shift, section.outline[:, 1] - 0.5 * section.height
    turn, distance = np.unwrap(np.arctan2(z, x)), np.hypot(x, z)
    # From below the floor the outline turns once; the last point closes it.
    radius = np.interp(np.mod(angle - turn[0], 2.0 * np.pi) + turn[0], turn, distance)
    wall = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    bearing = np.arctan2(wall[:, 1] + 0.5 * section.height - section.centre, wall[:, 0] - shift)
    order = np.argsort(np.mod(angle + 0.5 * np.pi, 2.0 * np.pi))
    around = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(wall[order], axis=0), axis=1))])
    girth = np.empty(N_ANGLES)
    girth[order] = around
    station = np.linspace(0.0, length, round(length / step) + 1)
    return Grid(station, angle, np.mod(bearing, 2.0 * np.pi), girth), radius


def _niches(boxes: Boxes, section: Section, shift: float, middle: float) -> Float[np.ndarray, "k 5"]:
    """Return niches as recesses of the wall."""
    height = 0.5 * (boxes.low + boxes.high)
    lateral = shift + boxes.side * section.wall(height)
    angle = np.mod(np.arctan2(height - middle, lateral), 2.0 * np.pi)
    length, width = boxes.end - boxes.start, boxes.high - boxes.low
    return np.column_stack([0.5 * (boxes.start + boxes.end), angle, length, width, -boxes.out])


def _bolt_pockets(
    rng: np.random.Generator, ranges: PocketRanges, rings: Rings, bolts: int, dowels: bool, section: Section,
    length: float,
) -> Float[np.ndarray, "p 5"]:  # fmt: skip
    """Draw pockets at either side of ring joints, and of the joints within a ring; angles are bearings."""
    size = [float(rng.uniform(*r)) for r in (ranges.length, ranges.width, ranges.depth)]
    offset = float(rng.uniform(*ranges.offset))
    pitch = 2.0 * np.pi / bolts
    at_joint = np.zeros((0, 2))
    if not dowels:
        angle = rings.turn[0] + pitch * np.arange(bolts)
        station = (rings.joint[:, None] + np.array([-offset, offset])).ravel()
        at_joint = np.stack(np.meshgrid(station, angle, indexing="ij"), axis=-1).reshape(-1, 2)
    ends = np.concatenate([[0.0], rings.joint, [length]])
    middle = 0.5 * (ends[1:] + ends[:-1])
    edges = rings.turn[:, None] + rings.edge
    turned = np.stack([edges - offset / section.half_width, edges + offset / section.half_width], axis=-1)
    station = np.broadcast_to(middle[:, None, None], turned.shape)
    within = np.stack([station, turned], axis=-1).reshape(-1, 2)
    place = np.concatenate([at_joint, within])
    fraction = 0.95 if rng.random() < ranges.grouted_fraction else float(rng.uniform(*ranges.missing))
    there = rng.random(len(place)) >= fraction
    reach = 0.5 * size[0] + _END
    there &= (place[:, 0] > reach) & (place[:, 0] < length - reach)
    rows = np.column_stack([place, np.broadcast_to(size, (len(place), 3))])
    return rows[there]


def _about_axis(pocket: np.ndarray, section: Section, shift: float, middle: float) -> Float[np.ndarray, "p 5"]:
    """Return pockets whose bearings about the middle of a circle are turned into angles about the axis."""
    lateral = shift + section.half_width * np.cos(pocket[:, 1])
    height = section.centre + section.half_width * np.sin(pocket[:, 1])
    angle = np.mod(np.arctan2(height - middle, lateral), 2.0 * np.pi)
    return np.column_stack([pocket[:, 0], angle, pocket[:, 2:]])


def _clear_pockets(
    pocket: np.ndarray, grid: Grid, outline: np.ndarray, middle: float, boxes: list[Boxes]
) -> Float[np.ndarray, "p 5"]:
    """Leave out pockets in the floor, behind fixtures, and too near to another pocket."""
    radius = np.interp(pocket[:, 1], grid.angle, outline, period=2.0 * np.pi)
    height, half = middle + radius * np.sin(pocket[:, 1]), 0.5 * pocket[:, 3]
    above = height - half > _BETWEEN
    pocket, height, half = pocket[above], height[above], half[above]
    side = np.where(np.cos(pocket[:, 1]) > 0.0, 1.0, -1.0)
    start, end = pocket[:, 0] - 0.5 * pocket[:, 2], pocket[:, 0] + 0.5 * pocket[:, 2]
    kept = np.ones(len(pocket), bool)
    for some in boxes:
        kept &= ~overlaps(some, side, start - _BETWEEN, end + _BETWEEN, height - half, height + half)
    pocket = pocket[kept]
    girth = np.interp(pocket[:, 1], grid.angle, grid.girth, period=2.0 * np.pi)
    return pocket[_first_of_crowds(pocket, girth)]


def _first_of_crowds(pocket: np.ndarray, girth: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
    """Return which pockets have no earlier one within `_BETWEEN`, both ways."""
    order = np.lexsort([girth, pocket[:, 0]])
    station, around = pocket[order, 0], girth[order]
    reach_along, reach_around = pocket[order, 2] + _BETWEEN, pocket[order, 3] + _BETWEEN
    crowded = np.zeros(len(order), bool)
    for lag in range(1, 64):
        near = station[lag:] - station[:-lag] < reach_along[lag:]
        if not near.any():
            break
        crowded[lag:] |= near & (np.abs(around[lag:] - around[:-lag]) < reach_around[lag:])
    kept = np.empty(len(order), bool)
    kept[order] = ~crowded
    return kept
