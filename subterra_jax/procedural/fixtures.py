"""Design section of a drawn bore, the place of the LiDAR in it, and things at its walls: niches, boxes, walkways."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from subterra_jax.procedural.kinds import (
    BENCHES,
    FIXTURES,
    MOUNT_HEIGHT,
    MOUNT_LATERAL,
    MOUNT_TILT,
    FixtureRanges,
    SectionRanges,
)

_OUTLINE = 4000  # points of an outline before it is sampled


@dataclasses.dataclass(frozen=True)
class Mount:
    """Place of the LiDAR on the robot."""

    height: float  # height above the floor, m
    lateral: float  # distance to the left of the robot's middle, m
    roll: float  # turn about the axis ahead, rad; the left side rises
    pitch: float  # turn about the axis to the left, rad; above 0 it looks down. Of no account in the plane

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Mount:
        height, lateral = rng.uniform(*MOUNT_HEIGHT), rng.uniform(*MOUNT_LATERAL)
        roll, pitch = MOUNT_TILT * np.clip(rng.normal(size=2), -3.0, 3.0)
        return cls(float(height), float(lateral), float(roll), float(pitch))

    def plane(self, lateral: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
        """Return the height of the plane of the planar LiDAR at a lateral, m."""
        return np.asarray(self.height + (np.asarray(lateral) - self.lateral) * np.tan(self.roll))


@dataclasses.dataclass(frozen=True)
class Section:
    """Design section as a closed outline, in the direction of growing angle from below the floor."""

    outline: Float[np.ndarray, "k 2"]  # points, m to the left of the lining's middle line and above the floor, `(k, 2)`
    centre: float  # height of the lining's own middle, m
    height: float  # height of the crown, m
    half_width: float  # half the largest width, m

    @classmethod
    def draw(cls, rng: np.random.Generator, ranges: SectionRanges) -> Section:
        """Draw a circle with a filled invert, or walls with an elliptic crown."""
        half = 0.5 * float(rng.uniform(*ranges.width))
        turn = np.linspace(-0.5 * np.pi, 1.5 * np.pi, _OUTLINE)
        if ranges.height is None:
            centre = half - float(rng.uniform(*ranges.fill))
            circle = half * np.stack([np.cos(turn), np.sin(turn)], axis=-1) + [0.0, centre]
            return cls(circle, centre, centre + half, half)
        height, foot = float(rng.uniform(*ranges.height)), float(rng.uniform(*ranges.foot))
        spring = height * float(rng.uniform(*ranges.spring))
        rise = np.linspace(-1.0, spring, _OUTLINE // 4)
        wall = np.stack([half - foot * (1.0 - rise / spring) ** 2, rise], axis=-1)
        arc = np.linspace(0.0, 0.5 * np.pi, _OUTLINE // 4)
        crown = np.stack([half * np.cos(arc), spring + (height - spring) * np.sin(arc)], axis=-1)
        left = np.concatenate([[[0.0, -1.0]], wall, crown[1:]])
        return cls(np.concatenate([left, left[-2::-1] * [-1.0, 1.0]]), 0.5 * height, height, half)

    def wall(self, height: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
        """Return half the width at heights above the floor and below the crown, m."""
        left = self.outline[(self.outline[:, 0] > 0.0) & (self.outline[:, 1] < self.height - 1e-3)]
        return np.asarray(np.interp(height, left[:, 1], left[:, 0]))

    def slope(self, height: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return how fast half the width grows with the height, 1, over 20 cm."""
        return (self.wall(height + 0.1) - self.wall(height - 0.1)) / 0.2


_END = 2.0  # ends of a tunnel without fixtures, m
_APART = 0.3  # least distance of two fixtures at one wall, m


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Boxes at a wall and niches in it."""

    start: Float[np.ndarray, " k"]  # station where each begins, m, `(k,)`
    end: Float[np.ndarray, " k"]  # station where it ends, m
    side: Float[np.ndarray, " k"]  # 1 at the left wall, -1 at the right
    out: Float[np.ndarray, " k"]  # height out of the wall, m; below 0 it is the depth of a niche
    face: Float[np.ndarray, " k"]  # lateral of its inner face without its sign, m; of a niche, of its mouth
    low: Float[np.ndarray, " k"]  # lower end above the floor, m
    high: Float[np.ndarray, " k"]  # upper end above the floor, m

    def where(self, chosen: Bool[np.ndarray, " k"]) -> Boxes:
        return Boxes(**{field.name: getattr(self, field.name)[chosen] for field in dataclasses.fields(self)})


@dataclasses.dataclass(frozen=True)
class Bench:
    """A walkway or covered trough along a whole wall: `side` 1 left or -1 right; `width` and height of its `top`, m."""

    side: float
    width: float
    top: float


def draw_benches(rng: np.random.Generator, items: tuple[str, ...]) -> tuple[Bench, ...]:
    """Draw the benches among some items; the first is on a drawn side, the second opposite."""
    side = float(rng.choice([-1.0, 1.0]))
    drawn = {name: (float(rng.uniform(*width)), float(rng.uniform(*top))) for name, (width, top) in BENCHES.items()}
    chosen = [drawn[name] for name in BENCHES if name in items]
    return tuple(Bench(side * sign, *size) for sign, size in zip((1.0, -1.0), chosen, strict=False))


def draw_boxes(
    rng: np.random.Generator,
    items: tuple[str, ...],
    section: Section,
    shift: float,
    length: float,
    before: Boxes | None = None,
) -> Boxes:
    """Draw boxes and niches of some items.

    Args:
        items: Names in `FIXTURES`; what comes first keeps its place, and what would overlap it is left out.
        section: Design section.
        shift: Lateral of its middle line, m.
        length: Length of the tunnel, m.
        before: Boxes that are there already.
    """
    none = np.zeros(0)
    made = Boxes(*(none,) * 7)
    for name, ranges in FIXTURES.items():
        some = _draw_item(rng, ranges, section, shift, length)  # drawn in any case, so that none moves another
        if name in items:
            for other in (made, *(() if before is None else (before,))):
                args = (some.side, some.start - _APART, some.end + _APART, some.low, some.high)
                free = ~overlaps(other, *args)
                some = some.where(free)
            made = Boxes(
                *(np.concatenate([a, b]) for a, b in zip(vars(made).values(), vars(some).values(), strict=True))
            )
    order = np.argsort(made.start, kind="stable")
    return Boxes(*(values[order] for values in vars(made).values()))


def _draw_item(rng: np.random.Generator, ranges: FixtureRanges, section: Section, shift: float, length: float) -> Boxes:
    spacing = rng.uniform(*ranges.spacing)
    size = [float(rng.uniform(*r)) for r in (ranges.length, ranges.depth, ranges.low, ranges.high)]
    first, sign = rng.uniform(0.0, spacing), float(rng.choice([-1.0, 1.0]))
    middle, side = [], []
    for k in range(ranges.sides):
        at = np.arange(first + k * spacing / ranges.sides, length, spacing)
        middle.append(at + ranges.jitter * spacing * rng.normal(size=len(at)))
        side.append(np.full(len(at), sign * (-1.0) ** k))
    place, where = np.concatenate(middle), np.concatenate(side)
    along, out, low, high = size
    inside = (place > _END + along) & (place < length - _END - along)
    place, where = place[inside], where[inside]
    # The nearest of the wall within its height, so that nothing hangs in the air.
    heights = np.linspace(max(low, 0.0), high, 9)
    nearest = section.wall(heights).min() - max(out, 0.0)
    full = np.full(len(place), 1.0)
    face = nearest + where * shift
    return Boxes(place - 0.5 * along, place + 0.5 * along, where, out * full, face, low * full, high * full)


def overlaps(
    boxes: Boxes,
    side: Float[np.ndarray, " p"],
    start: Float[np.ndarray, " p"],
    end: Float[np.ndarray, " p"],
    low: Float[np.ndarray, " p"],
    high: Float[np.ndarray, " p"],
) -> Bool[np.ndarray, " p"]:
    """Return which rectangles on the walls (side 1 left, -1 right; stations, m; edges, m) overlap one of the boxes."""
    hit = np.zeros(len(side), bool)
    order = np.argsort(start)
    longest = float(np.max(end - start, initial=0.0))
    for i in range(len(boxes.start)):
        rows = order[slice(*np.searchsorted(start[order], [boxes.start[i] - longest, boxes.end[i]]))]
        meets = (side[rows] == boxes.side[i]) & (end[rows] > boxes.start[i])
        hit[rows] |= meets & (low[rows] < boxes.high[i]) & (high[rows] > boxes.low[i])
    return hit
