"""Things in the bore, and the ground before a portal: what a scanner sees that is no lining."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.survey.alignment import Alignment
from scene.survey.mesh import Mesh, Part
from scene.survey.section import Field, Section, draw_field

_STEP = 0.25  # m between the corners of a long thing
_BURIED = 0.005  # m that things on the floor stand in it


@dataclass(frozen=True)
class Thing:
    """A thing with one outline all along: a box, a pipe, a kerb."""

    kind: str  # Name
    start: float  # First station, m
    end: float  # Last station, m
    outline: Float[np.ndarray, "k 2"]  # Convex corners, left of the axis and above the floor, anticlockwise, m

    def describe(self) -> dict[str, Any]:
        """Return its entry in `truth.json`: its box by station, left and above the floor, m."""
        (right, low), (left, high) = self.outline.min(axis=0), self.outline.max(axis=0)
        sizes = {"start": self.start, "end": self.end, "right": right, "left": left, "low": low, "high": high}
        return {"kind": self.kind, **{name: round(float(value), 6) for name, value in sizes.items()}}


def box_thing(kind: str, station: tuple[float, float], left: tuple[float, float], above: tuple[float, float]) -> Thing:
    """Return a box between two stations, two offsets to the left and two heights above the floor, m."""
    (right, end), (low, high) = sorted(left), above
    return Thing(kind, *station, np.array([(end, low), (end, high), (right, high), (right, low)]))


def round_thing(kind: str, station: tuple[float, float], left: float, above: float, radius: float) -> Thing:
    """Return a pipe of a radius about a line `left` of the axis and `above` the floor, m."""
    turn = np.linspace(0.0, 2.0 * np.pi, 25)[:-1]
    outline = np.array([left, above]) + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return Thing(kind, *station, outline)


def thing_mesh(alignment: Alignment, section: Section, thing: Thing) -> Mesh:
    """Return the closed surface of a thing, bent along the bore."""
    count = max(2, int(np.ceil((thing.end - thing.start) / _STEP)) + 1)
    stations = np.linspace(thing.start, thing.end, count)
    k = len(thing.outline)
    height = thing.outline[:, 1] - 0.5 * section.height(stations)[:, None]
    height = np.where(thing.outline[:, 1] <= 0.0, height - _BURIED, height)
    vertices = alignment.frames(stations).point(np.broadcast_to(thing.outline[:, 0], (count, k)), height)
    ring = np.arange(k)
    ahead = np.roll(ring, -1)
    wall = np.concatenate([np.stack([ring, ahead, ring + k], 1), np.stack([ahead, ahead + k, ring + k], 1)])
    walls = (wall + k * np.arange(count - 1)[:, None, None]).reshape(-1, 3)
    fan = np.stack([np.zeros(k - 2, int), ring[1:-1], ring[2:]], 1)
    # Anticlockwise seen along the bore, from left towards up: such a fan faces back along it.
    faces = np.concatenate([walls, fan[:, ::-1], fan + k * (count - 1)])
    at = np.concatenate([stations[:-1].repeat(len(wall)), np.full(k - 2, thing.start), np.full(k - 2, thing.end)])
    return Mesh(vertices.reshape(-1, 3), faces, np.full(len(faces), Part.THING, np.uint8), at)


@dataclass(frozen=True)
class Cutting:
    """The ground before the last mouth: a bottom at the floor's height, slopes with grass, and a headwall."""

    run: float  # Length, m
    bottom: float  # Half-width of the bottom, m
    slope: float  # Run of the slopes over their rise
    height: float  # Height of the slopes, m
    grass: Field  # Unevenness of the slopes by station and offset, m

    def describe(self) -> dict[str, Any]:
        """Return its entry in `truth.json`."""
        return {name: round(float(getattr(self, name)), 6) for name in ("run", "bottom", "slope", "height")}


def draw_cutting(rng: np.random.Generator, half_width: float) -> Cutting:
    """Draws a cutting of 12 to 18 m before a mouth of a half-width, m."""
    return Cutting(
        run=rng.uniform(12.0, 18.0), bottom=half_width + rng.uniform(0.3, 1.2), slope=rng.uniform(0.8, 1.3),
        height=rng.uniform(6.0, 8.0), grass=draw_field(rng, 0.08, 0.5, dims=2, terms=256),
    )  # fmt: skip


_GROUND = 0.2  # m, cells of the ground
_BANK = 3.0  # m of level ground beyond the slopes
_HEADWALL = 9.0  # m that the headwall reaches beyond the mouth


def cutting_mesh(alignment: Alignment, section: Section, cutting: Cutting) -> Mesh:
    """Return ground and headwall of a cutting, with normals towards the air."""
    length = alignment.length
    station = np.linspace(length, length + cutting.run, int(np.ceil(cutting.run / _GROUND)) + 1)
    widest = cutting.bottom + cutting.slope * cutting.height + _BANK
    left = np.linspace(-widest, widest, int(np.ceil(2.0 * widest / _GROUND)) + 1)
    rise = np.clip((np.abs(left) - cutting.bottom) / cutting.slope, 0.0, cutting.height)
    grass = np.where(rise > 0.0, cutting.grass.over(station, left), 0.0)
    floor = -0.5 * section.height(station)[:, None]
    ground = alignment.frames(station).point(np.broadcast_to(left, grass.shape), floor + rise + grass)
    n, m = grass.shape
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])

    end = np.array([length])
    mouth = section.rough(end)[0]
    ray = mouth - (0.0, -0.5 * float(section.height(end)[0]))  # from the middle of the floor, so that no two cross
    outer = mouth + _HEADWALL * ray / np.linalg.norm(ray, axis=1, keepdims=True)
    wall = alignment.frames(end).point(
        np.concatenate([mouth, outer])[None, :, 0], np.concatenate([mouth, outer])[None, :, 1]
    )[0]
    k = len(mouth)
    ring, start = np.arange(k - 1), n * m
    head = np.concatenate([np.stack([ring, ring + k, ring + 1], 1), np.stack([ring + 1, ring + k, ring + k + 1], 1)])
    at = np.concatenate(
        [np.tile(0.5 * (station[1:] + station[:-1])[:, None], (2, m - 1)).ravel(), np.full(len(head), length)]
    )
    whole = np.concatenate([faces, head + start])
    return Mesh(np.concatenate([ground.reshape(-1, 3), wall]), whole, np.full(len(whole), Part.TERRAIN, np.uint8), at)
