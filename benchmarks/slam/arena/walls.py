"""Bores of the dial of degeneracy: one straight D section, from walls that show no motion to walls that show it all.

Everything but the walls stays: section, length, heading and the drive through it. A bore is `Bore` of the simulated
survey, which shares no code with the builder of scenes.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from scene.survey.alignment import MARGIN, Elements, lay_out
from scene.survey.bore import Bore, Thing, box_thing, round_thing
from scene.survey.furniture import Furniture, draw_furniture
from scene.survey.section import Section, d_shape, draw_field

WallName = Literal["smooth", "joints", "pockets", "furnished", "sprayed"]
WALLS: tuple[WallName, ...] = ("smooth", "joints", "pockets", "furnished", "sprayed")  # in the order of the dial

_SMOOTH_SIGMA, _SMOOTH_LENGTH = 0.002, 1.5  # m: precast lining, unevenness within a ring and its length
# m, offset of a ring from the next, 1 σ. Tolerance of a built ring: 10 mm of step at a joint (BTS 2010, 5 mm in the
# ring); two neighbours of 4 mm differ by 6 mm.
_STEP_SIGMA = 0.004
# m: sprayed concrete without a finish. An assumption near scans of such walls, of tenths of a metre within a metre.
_SPRAYED_SIGMA, _SPRAYED_LENGTH = 0.06, 0.7
_CABINETS = 6.0  # m, mean distance of the cabinets along either wall


@dataclass(frozen=True)
class RingedSection(Section):
    """A section whose rings stand off from each other at the joints."""

    joints: Float[np.ndarray, "r"] = field(default_factory=lambda: np.empty(0))  # Stations of the joints, m
    offset: Float[np.ndarray, "r+1"] = field(default_factory=lambda: np.zeros(1))  # Of the ring before each, outward, m

    def rough(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        """Return nodes of the actual lining, without pockets, about the centreline, m."""
        nodes = super().rough(station)
        ring = np.searchsorted(self.joints, station, side="right")
        nodes += self.offset[ring][:, None, None] * self.shape.normal
        self._on_floor(nodes, self.height(station))
        return nodes


def draw_walls(seed: np.random.SeedSequence, walls: WallName, length: float) -> Bore:
    """Draws a straight, level bore with such walls.

    Args:
        seed: Draws heading, unevenness and furniture.
        walls: Position on the dial.
        length: Length between the mouths, m.
    """
    of_place, of_walls, of_things = (np.random.default_rng(one) for one in seed.spawn(3))
    ends = np.array([-MARGIN, length + MARGIN])
    alignment = lay_out(of_place, length, Elements(ends, np.zeros(2), ends, np.zeros(2)))
    furniture = _furnish(draw_furniture(of_things, length), walls)
    sprayed = walls == "sprayed"
    sizes = (_SPRAYED_SIGMA, _SPRAYED_LENGTH) if sprayed else (_SMOOTH_SIGMA, _SMOOTH_LENGTH)
    section = RingedSection(
        d_shape(),
        width_field=draw_field(of_walls, 0.0, 10.0),
        height_field=draw_field(of_walls, 0.0, 10.0),
        roughness=draw_field(of_walls, *sizes, dims=2, terms=256),
        joints=furniture.joints,
        offset=_STEP_SIGMA * of_walls.standard_normal(len(furniture.joints) + 1) * float(len(furniture.joints) > 0),
    )
    things = _draw_things(of_things, length) if walls == "furnished" else ()
    return Bore("D", alignment, section, furniture, things)


def _furnish(furniture: Furniture, walls: WallName) -> Furniture:
    """Returns what of a bore's furniture stands at a position of the dial; the drawn places stay the same."""
    if walls in ("smooth", "sprayed"):
        empty = replace(furniture, joints=furniture.joints[:0], pocketed=furniture.pocketed[:0])
        empty = replace(empty, filled=furniture.filled[:0], depth=furniture.depth[:0], nails=furniture.nails[:0])
        return replace(empty, sleepers=furniture.sleepers[:0], tracks=())
    if walls == "joints":
        none = np.zeros_like(furniture.pocketed)
        furniture = replace(furniture, pocketed=none, nails=np.zeros_like(furniture.nails))
    return furniture if walls == "furnished" else replace(furniture, sleepers=furniture.sleepers[:0], tracks=())


def _draw_things(rng: np.random.Generator, length: float) -> tuple[Thing, ...]:
    """Draws cabinets of uneven sizes at uneven distances along both walls, hydrants, signs, and a pipe."""
    things = [round_thing("pipe", (0.0, length), 2.55, 0.6, 0.08)]
    for side in (-1.0, 1.0):
        at = rng.uniform(0.0, _CABINETS)
        while at < length - 3.0:
            run, depth, top = rng.uniform(0.4, 1.6), rng.uniform(0.25, 0.55), rng.uniform(0.8, 2.0)
            things.append(box_thing("cabinet", (at, at + run), (side * 2.9, side * (2.825 - depth)), (0.0, top)))
            sign = at + run + rng.uniform(0.3, 1.5)
            if sign < length - 1.0:
                things.append(box_thing("sign", (sign, sign + 0.06), (side * 2.9, side * 2.3), (2.2, 2.8)))
            at += run + rng.uniform(0.4, 1.6) * _CABINETS
    return tuple(things)
