"""The true bore: everything that is drawn once and then surveyed, and what stands in it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.survey.alignment import Alignment, Elements, draw_railway, lay_out, metro_elements
from scene.survey.config import TruthName
from scene.survey.furniture import DESIGN, Furniture, Sizes, draw_furniture, draw_sizes
from scene.survey.mesh import Mesh, Part, join_meshes, nail_mesh, surface_mesh, track_mesh
from scene.survey.section import Section, Shape, Trend, arch, circle, d_shape, draw_field, horseshoe

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


# The paper counts 351 m / 0.6 m + 1 = 586 sleepers, which needs one in the middle of each mouth. So far apart, 586 lie
# whole between the mouths wherever the first is drawn; 0.6 m apart there are 585.
_PAPER_SLEEPERS = Sizes(sleeper_spacing=0.5988)
_SIGMA, _IRREGULAR_SIGMA = 0.01, 0.13  # m, standard deviation of walls
_CROSSFALL = 0.02  # of the irregular bore's floor


@dataclass(frozen=True)
class Bore:
    """Centreline, section and furniture of one bore, and the name of its class of section."""

    section_type: str
    alignment: Alignment
    section: Section
    furniture: Furniture
    things: tuple[Thing, ...] = ()  # What stands or hangs in it

    def mesh(self) -> Mesh:
        parts = (self.alignment, self.section, self.furniture)
        meshes = [surface_mesh(*parts), track_mesh(*parts), nail_mesh(*parts)]
        meshes += [thing_mesh(self.alignment, self.section, thing) for thing in self.things]
        mesh = join_meshes(meshes)
        # To the micrometre, so that the last bits of a matrix product do not decide about the bytes of a survey.
        return replace(mesh, vertices=np.round(mesh.vertices, 6))


def _flare(length: float, run: float, width: float) -> Trend:
    """Return a last mouth that is wider, opening with the square of the distance over a run, m."""
    fraction = np.linspace(0.0, 1.0, int(run) + 1)
    return Trend(tuple(length - run + run * fraction), tuple(width * fraction**2))


@dataclass(frozen=True)
class _Class:
    section_type: str
    shape: Callable[[], Shape] = d_shape
    elements: Callable[[np.random.Generator, float], Elements] = draw_railway
    widening: Callable[[float], Trend] = lambda length: Trend()
    rough: bool = False  # Walls as irregular as a mine's, without rings
    sizes: Sizes = DESIGN


_CLASSES: dict[TruthName, _Class] = {
    "paper": _Class("D"),
    "metro": _Class("D", elements=metro_elements, sizes=_PAPER_SLEEPERS),
    "horseshoe": _Class("horseshoe", horseshoe),
    "irregular": _Class("irregular", arch, widening=lambda length: _flare(length, 6.0, 3.0), rough=True),
    "circle": _Class("circle", circle),
}


def _draw_section(rng: np.random.Generator, kind: _Class, length: float, correlation: float) -> Section:
    """Draws width and height (1 σ of 5 cm over 8 to 15 m) and roughness (1 cm over 1 to 2 m, or irregular)."""
    width, height = (draw_field(rng, 0.05, rng.uniform(8.0, 15.0)) for _ in range(2))
    sigma, run = (_IRREGULAR_SIGMA, correlation) if kind.rough else (_SIGMA, rng.uniform(1.0, 2.0))
    roughness = draw_field(rng, sigma, run, dims=2, terms=256)
    return Section(kind.shape(), width, height, roughness, kind.widening(length), _CROSSFALL if kind.rough else 0.0)


def draw_bore(
    seed: np.random.SeedSequence,
    length: float,
    truth: TruthName = "paper",
    correlation: float = 2.0,
    tolerances: bool = False,
) -> Bore:
    """Draws a bore of a length between the mouths, m, and a class.

    `correlation` is the length in which the walls of `irregular` decorrelate, m; the others do not use it. With
    `tolerances` the sizes of track, rings and pockets are drawn too; the other draws stay as they are without.
    """
    first, second, third, _, fifth = (np.random.default_rng(s) for s in seed.spawn(5))
    kind = _CLASSES[truth]
    sizes = draw_sizes(fifth) if tolerances else kind.sizes
    alignment = lay_out(first, length, kind.elements(first, length))
    section = _draw_section(second, kind, length, correlation)
    furniture = replace(draw_furniture(third, length, not kind.rough, sizes), tracks=(sizes.track_aside,))
    return Bore(kind.section_type, alignment, section, furniture)
