"""The true bore: everything that is drawn once and then surveyed, what stands in it, and the ground before a portal."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.survey.alignment import Alignment, Elements, draw_railway, lay_out, metro_elements
from scene.survey.config import TruthName
from scene.survey.furniture import DESIGN, SLEEPER_RISE, Furniture, Sizes, draw_furniture, draw_sizes
from scene.survey.mesh import Mesh, Part, join_meshes, nail_mesh, surface_mesh, track_mesh
from scene.survey.section import (
    Field,
    Section,
    Shape,
    Trend,
    arch,
    circle,
    d_shape,
    draw_field,
    horseshoe,
    rectangle,
    vault,
)  # fmt: skip

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


@dataclass(frozen=True)
class Cutting:
    """The ground before the last mouth: a bottom at the floor's height, slopes with grass, and a headwall."""

    run: float  # Length, m
    bottom: float  # Half-width of the bottom, m
    slope: float  # Run of the slopes over their rise
    height: float  # Height of the slopes, m
    grass: Field  # Unevenness of the slopes by station and offset, m

    def describe(self) -> dict[str, Any]:
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


# The paper counts 351 m / 0.6 m + 1 = 586 sleepers, which needs one in the middle of each mouth. So far apart, 586 lie
# whole between the mouths wherever the first is drawn; 0.6 m apart there are 585.
_PAPER_SLEEPERS = Sizes(sleeper_spacing=0.5988)
_IRREGULAR_SIGMA = 0.13  # m, standard deviation of the walls
_CROSSFALL = 0.02  # of the irregular bore's floor


@dataclass(frozen=True)
class Bore:
    """Centreline, section and furniture of one bore, and the name of its class of section."""

    section_type: str
    alignment: Alignment
    section: Section
    furniture: Furniture
    things: tuple[Thing, ...] = ()  # What stands or hangs in it
    cutting: Cutting | None = None  # The ground before its last mouth
    strays: float = 0.0  # Share of the returns that come from behind the wall, by whatever the wall is made of

    def mesh(self) -> Mesh:
        parts = (self.alignment, self.section, self.furniture)
        meshes = [surface_mesh(*parts), track_mesh(*parts), nail_mesh(*parts)]
        meshes += [thing_mesh(self.alignment, self.section, thing) for thing in self.things]
        meshes += [cutting_mesh(self.alignment, self.section, self.cutting)] if self.cutting else []
        mesh = join_meshes(meshes)
        # To the micrometre, so that the last bits of a matrix product do not decide about the bytes of a survey.
        return replace(mesh, vertices=np.round(mesh.vertices, 6))


def _flare(length: float, run: float, width: float) -> Trend:
    """Return a last mouth that is wider, opening with the square of the distance over a run, m."""
    share = np.linspace(0.0, 1.0, int(run) + 1)
    return Trend(tuple(length - run + run * share), tuple(width * share**2))


def _one_sided(length: float, start: float, end: float, width: float) -> Trend:
    """Return a widening between two shares of a length, with ramps outside them, m."""
    ramp = min(4.0, 0.1 * length)
    return Trend((start * length - ramp, start * length, end * length, end * length + ramp), (0.0, width, width, 0.0))


def _alcoves(length: float) -> Trend:
    """Return two alcoves 2 m long and 60 cm deep."""
    first, second = 0.3 * length, 0.7 * length
    knots = [(s + d, v) for s in (first, second) for d, v in ((-0.1, 0.0), (0.0, 0.6), (2.0, 0.6), (2.1, 0.0))]
    return Trend(tuple(k for k, _ in knots), tuple(v for _, v in knots))


def _works_things(rng: np.random.Generator, length: float) -> tuple[Thing, ...]:
    """Return a parked vehicle of up to 7.5 m on one side, and two people on the other."""
    side, at = rng.choice([-1.0, 1.0]), rng.uniform(0.25, 0.4) * length
    run = min(7.5, 0.3 * length)
    vehicle = [
        box_thing("vehicle", (at, at + run), (side * 0.85, side * 2.4), (0.35, 1.2)),
        box_thing("vehicle", (at + 0.25 * run, at + run), (side * 0.85, side * 2.4), (1.15, 2.3)),
        *(
            box_thing("vehicle", (at + s * run, at + s * run + 0.6), (side * 0.9, side * 2.3), (0.0, 0.4))
            for s in (0.1, 0.8)
        ),
    ]
    stands = at + run * np.array([-0.8, 1.6]) + rng.uniform(-0.5, 0.5, 2)
    people = [box_thing("person", (s, s + 0.35), (-side * 1.2, -side * 1.7), (0.0, 1.75)) for s in stands]
    return (*vehicle, *people)


def _platform_things(rng: np.random.Generator, length: float) -> tuple[Thing, ...]:
    """Return a platform 1 m high along the widening."""
    return (box_thing("platform", (0.35 * length, 0.65 * length), (1.75, 6.2), (0.0, 1.0)),)


def _road_things(rng: np.random.Generator, length: float) -> tuple[Thing, ...]:
    """Return walkways on both sides, and pairs of jet fans under the crown every 25 m."""
    walkways = [box_thing("walkway", (0.0, length), (s * 4.0, s * 7.8), (0.0, 0.25)) for s in (-1.0, 1.0)]
    at = np.arange(rng.uniform(0.1, 0.3) * length, 0.9 * length - 3.0, 25.0)
    fans = [round_thing("jet fan", (s, s + 3.0), left, 5.9, 0.35) for s in at for left in (-1.3, 1.3)]
    return (*walkways, *fans)


def _corridor_things(rng: np.random.Generator, length: float) -> tuple[Thing, ...]:
    """Return pipes and cable trays under the ceiling, and cabinets along the right wall."""
    pipes = [round_thing("pipe", (0.0, length), left, 3.75, 0.16) for left in (-1.1, -0.6)]
    trays = [box_thing("tray", (0.0, length), (left, left + 0.5), (3.5, 3.6)) for left in (0.4, 1.3)]
    at = np.sort(rng.uniform(0.1, 0.9, max(2, int(length / 8.0)))) * length
    cabinets = [box_thing("cabinet", (s, s + 0.8), (-2.2, -2.75), (0.0, 1.9)) for s in at]
    return (*pipes, *trays, *cabinets)


@dataclass(frozen=True)
class _Class:
    section_type: str
    shape: Callable[[], Shape] = d_shape
    elements: Callable[[np.random.Generator, float], Elements] = draw_railway
    widening: Callable[[float], Trend] = lambda length: Trend()
    rough: bool = False
    aside: Callable[[float], Trend] = lambda length: Trend()
    roughness: float = 0.01  # m, standard deviation of the walls that are not irregular
    rings: bool = True
    tracks: tuple[float, ...] = (0.0,)  # m to the left
    rise: float = SLEEPER_RISE  # m
    things: Callable[[np.random.Generator, float], tuple[Thing, ...]] = lambda rng, length: ()
    cutting: bool = False
    dark: float = 0.0  # m of lining that give no echo
    strays: float = 0.0
    sizes: Sizes = DESIGN


_CLASSES: dict[TruthName, _Class] = {
    "paper": _Class("D"),
    "metro": _Class("D", elements=metro_elements, sizes=_PAPER_SLEEPERS),
    "horseshoe": _Class("horseshoe", horseshoe),
    "irregular": _Class("irregular", arch, widening=lambda length: _flare(length, 6.0, 3.0), rough=True),
    "circle": _Class("circle", circle),
    "portal": _Class(
        "horseshoe", lambda: vault(8.7, 6.6, 3.0, 0.3), widening=lambda length: _flare(length, 8.0, 2.5),
        roughness=0.04, rings=False, tracks=(2.0, -2.0), cutting=True,
    ),
    "corridor": _Class(
        "rectangle", lambda: rectangle(5.1, 4.4), aside=_alcoves, roughness=0.003, rings=False, tracks=(),
        things=_corridor_things,
    ),
    "works": _Class("D", rings=False, things=_works_things, dark=4.0, strays=0.03),
    "platform": _Class(
        "D, widening", arch, aside=lambda length: _one_sided(length, 0.35, 0.65, 3.0), rings=False,
        things=_platform_things,
    ),
    "road": _Class(
        "road", lambda: vault(9.6, 7.0, 2.6), aside=lambda length: _one_sided(length, 0.4, 0.6, 2.5), rings=False,
        tracks=(), things=_road_things,
    ),
    "slabtrack": _Class("horseshoe", lambda: vault(5.1, 5.5, 3.0, 0.25), rings=False, rise=0.22),
}  # fmt: skip


def _draw_section(rng: np.random.Generator, kind: _Class, length: float, correlation: float) -> Section:
    """Draws width and height (1 σ of 5 cm over 8 to 15 m) and roughness (1 cm over 1 to 2 m, or irregular)."""
    return Section(
        kind.shape(),
        width_field=draw_field(rng, 0.05, rng.uniform(8.0, 15.0)),
        height_field=draw_field(rng, 0.05, rng.uniform(8.0, 15.0)),
        roughness=draw_field(
            rng,
            _IRREGULAR_SIGMA if kind.rough else kind.roughness,
            correlation if kind.rough else rng.uniform(1.0, 2.0),
            dims=2,
            terms=256,
        ),
        widening=kind.widening(length),
        aside=kind.aside(length),
        crossfall=_CROSSFALL if kind.rough else 0.0,
    )


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
    first, second, third, fourth, fifth = (np.random.default_rng(s) for s in seed.spawn(5))
    kind = _CLASSES[truth]
    sizes = draw_sizes(fifth) if tolerances else kind.sizes
    alignment = lay_out(first, length, kind.elements(first, length))
    section = _draw_section(second, kind, length, correlation)
    furniture = draw_furniture(third, length, kind.rings and not kind.rough, sizes)
    things = kind.things(fourth, length)
    begin = fourth.uniform(0.65, 0.75) * length
    tracks = tuple(middle + sizes.track_aside for middle in kind.tracks)
    furniture = replace(furniture, tracks=tracks, rise=kind.rise, dark=(begin, begin + kind.dark))
    if not kind.tracks:
        furniture = replace(furniture, sleepers=np.empty(0))
    cutting = draw_cutting(fourth, 0.5 * float(section.width(np.array([length]))[0])) if kind.cutting else None
    return Bore(kind.section_type, alignment, section, furniture, things, cutting, kind.strays)
