"""The open world: tunnels of every kind of lining by name, and which of them are for learning, choosing and scoring.

`open:SPLIT:INDEX` is a tunnel of the split's kinds in turn, `open:KIND:SPLIT:INDEX` one of a kind. Splits differ by
seed and by what is drawn: `train`, `val` and `test-seen` share kinds and furniture; `test-unseen` has the kinds that
they lack, and of their kinds the amount of furniture that they lack.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.texture import texture_seed
from subterra_jax.procedural.bore import Bore, draw_bore
from subterra_jax.procedural.cut import Cut, cut_lining, plane_walls
from subterra_jax.procedural.geometry import Alignment, LineRanges, draw_alignment, wander
from subterra_jax.procedural.kinds import (
    BENCHES,
    FIXTURES,
    KINDS,
    LENGTH,
    MOUNT_HEIGHT,
    MOUNT_LATERAL,
    MOUNT_TILT,
)
from subterra_jax.procedural.solid import make_shell
from subterra_jax.tunnel.plan import TunnelPlan

VARIANTS = ("built", "bare", "smooth")
LEVELS = ("none", "some", "all")  # of furniture
# Amount of furniture that a trained kind has in `test-unseen` alone. A kind that is not here is never trained on.
HELD_OUT = {"straight": "all", "cast": "none", "sprayed": "some", "masonry": "all"}
SPLIT_SIZE = 1_000_000
SPLITS = {name: i * SPLIT_SIZE for i, name in enumerate(("train", "val", "test-seen", "test-unseen"))}
UNSEEN = "test-unseen"
_FAMILY = 19  # tells the seeds of this family from those of others
_STREAMS = ("line", "section", "surface", "pocket", "furniture", "mount", "grade", "items")
_NAME = re.compile(r"open:(?:([a-z]+):)?([a-z-]+):(\d+)")
_HALF = 0.5  # fraction of the furniture of a kind that a tunnel with `some` has
_ROOM = 1.0  # m to either side over which the narrowest place counts as the half width

# Radii of main lines and metros; from memory, not looked up.
LINE = LineRanges(radius=(150.0, 3000.0), straight=(40.0, 400.0), arc=(40.0, 300.0), transition=(30.0, 90.0), turn=1.2)
GRADE_SD, GRADE_MOST, GRADE_WAVE = 0.01, 0.035, 250.0  # 1, 1, m: slopes of railways, from memory, not looked up


def kinds_of(split: str) -> tuple[str, ...]:
    """Return the kinds of a split, in the order in which its tunnels have them."""
    return tuple(KINDS) if split == UNSEEN else tuple(HELD_OUT)


def levels_of(kind: str, split: str) -> tuple[str, ...]:
    """Return the amounts of furniture that tunnels of a kind have in a split."""
    if kind not in HELD_OUT:
        return LEVELS
    return tuple(level for level in LEVELS if (level == HELD_OUT[kind]) == (split == UNSEEN))


def figures() -> dict[str, Any]:
    """Return every number that defines the open world, as plain values; the tests list every key."""
    return {
        "kinds": {name: dataclasses.asdict(kind) for name, kind in KINDS.items()},
        "order": list(KINDS),
        "fixtures": {name: dataclasses.asdict(ranges) for name, ranges in FIXTURES.items()},
        "benches": BENCHES,
        "mount": (MOUNT_HEIGHT, MOUNT_LATERAL, MOUNT_TILT),
        "length": LENGTH,
        "splits": SPLITS,
        "held_out": HELD_OUT,
        "line": dataclasses.asdict(LINE),
        "grade": (GRADE_SD, GRADE_MOST, GRADE_WAVE),
        "fraction": _HALF,
    }


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A tunnel drawn from the open world.

    Attributes:
        name: Its name.
        furniture: Amount of furniture: `none`, `some` or `all`.
        items: Furniture that it has.
        alignment: Centreline in plan.
        grade: Height of the floor at the stations of the centreline, m, `(n,)`.
        bore: The bore.
    """

    name: str
    furniture: str
    items: tuple[str, ...]
    alignment: Alignment
    grade: np.ndarray
    bore: Bore


def draw(name: str, length: float | None = None) -> Drawn:
    """Draw a tunnel by its name.

    Args:
        name: `open:SPLIT:INDEX` or `open:KIND:SPLIT:INDEX`.
        length: Length in place of the drawn one, m, for pictures and tests: such a tunnel is not the one of that name.

    Raises:
        TunnelError: There is no such kind, split or tunnel, or the split does not have the kind.
    """
    kind, split, index = _parse(name)
    rng = _generators(kind, split, index)
    ranges = KINDS[kind]
    level = str(rng["items"].choice(levels_of(kind, split)))
    fraction = {"none": 0.0, "some": _HALF, "all": 1.0}[level]
    items = tuple(item for item in ranges.fixtures if rng["items"].random() < fraction)
    drawn_length = _draw_length(rng["line"])
    length = drawn_length if length is None else length
    alignment = draw_alignment(rng["line"], length, LINE)
    step = alignment.station[1]
    slope = np.clip(wander(rng["grade"], alignment.station, GRADE_SD, GRADE_WAVE), -GRADE_MOST, GRADE_MOST)
    height = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * step)])
    bore = draw_bore(ranges, length, items, [rng[name] for name in _STREAMS[1:6]])
    return Drawn(name, level, items, alignment, height, bore)


def _generators(kind: str, split: str, index: int) -> dict[str, np.random.Generator]:
    """Return the random generators of a tunnel by what they draw, so that none moves another."""
    sequence = np.random.SeedSequence([_FAMILY, list(KINDS).index(kind), SPLITS[split] + index])
    return dict(zip(_STREAMS, (np.random.default_rng(child) for child in sequence.spawn(len(_STREAMS))), strict=True))


def _draw_length(line: np.random.Generator) -> float:
    """Draw the length of a tunnel, m; it is the first number of its line."""
    return float(np.exp(line.uniform(*np.log(LENGTH))))


def shortest(split: str, kinds: Sequence[str] = (), among: int = 100) -> list[str]:
    """Return the shortest of the first tunnels of some kinds of a split, by name; of each kind if none is given."""

    def shortest_of(kind: str) -> int:
        return min(range(among), key=lambda index: _draw_length(_generators(kind, split, index)["line"]))

    return [f"open:{kind}:{split}:{shortest_of(kind)}" for kind in kinds or kinds_of(split)]


def plan(
    name: str, *, variants: tuple[str, ...] = VARIANTS, solid: bool = True, length: float | None = None
) -> TunnelPlan:
    """Generate a tunnel by its name.

    With one version of NumPy, the same name gives the same tunnel to the bit.

    Args:
        name: `open:SPLIT:INDEX` or `open:KIND:SPLIT:INDEX`.
        variants: Of `built`, `bare` (without furniture) and `smooth` (without relief, pockets and furniture).
        solid: Make the bore in three dimensions too, of which the plan is the cut by the LiDAR's plane; it takes some
            seconds a kilometre where walls are rough.
        length: As for `draw`.

    Raises:
        TunnelError: There is no such tunnel.
    """
    drawn = draw(name, length)
    bore, alignment = drawn.bore, drawn.alignment
    station = alignment.station
    rings, rough = bore.rings, plane_walls(bore)
    return TunnelPlan(
        name=name,
        provenance="simulated",
        station=station,
        centre=alignment.position(station),
        tangent=alignment.tangent(station),
        elevation=drawn.grade,
        half_width=_half_width(bore, station, rough),
        lidar_height=bore.mount.height,
        linings={variant: cut_lining(bore, alignment, variant, rough) for variant in variants},
        ring_pitch=0.0 if rings is None else rings.nominal,
        shell=make_shell(drawn.bore, alignment, drawn.grade, variants) if solid else None,
        texture=texture_seed(name),
    )


def _half_width(bore: Bore, station: np.ndarray, rough: Cut) -> np.ndarray:
    """Return the distance of the nearer wall without pockets and fixtures, the least within a metre, m."""
    nearest = np.minimum(*rough.values())
    nearest = np.minimum(nearest, bore.bench_room())
    reach = round(_ROOM / bore.kind.step)
    rows = np.lib.stride_tricks.sliding_window_view(np.pad(nearest, reach, mode="edge"), 2 * reach + 1)
    return np.interp(station, bore.grid.station, rows.min(axis=1))


def in_benchmark(name: str) -> bool:
    """Tell whether a name is of a tunnel of the open world."""
    match = _NAME.fullmatch(name)
    return match is not None and (match[1] is None or match[1] in KINDS)


def _parse(name: str) -> tuple[str, str, int]:
    """Return kind, split and index of a tunnel's name."""
    match = _NAME.fullmatch(name)
    if match is None:
        raise TunnelError(
            f"no tunnel {name!r}; one of the open world is called open:SPLIT:INDEX or open:KIND:SPLIT:INDEX, as in "
            f"open:cast:val:7; kinds are {', '.join(KINDS)}, splits {', '.join(SPLITS)}"
        )
    kind, split, index = match[1], match[2], int(match[3])
    if kind is not None and kind not in KINDS:
        raise TunnelError(f"no tunnel {name!r}: there is no kind {kind!r}; there are {', '.join(KINDS)}")
    if split not in SPLITS:
        raise TunnelError(f"no tunnel {name!r}: there is no split {split!r}; there are {', '.join(SPLITS)}")
    if index >= SPLIT_SIZE:
        raise TunnelError(f"no tunnel {name!r}: split {split!r} has tunnels 0 to {SPLIT_SIZE - 1}")
    there = kinds_of(split)
    if kind is not None and kind not in there:
        raise TunnelError(f"no tunnel {name!r}: {kind!r} is in {UNSEEN} alone; {split!r} has {', '.join(there)}")
    return kind or there[index % len(there)], split, index
