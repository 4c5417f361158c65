"""Tunnels by name: the older family of ranges, which keeps to the bit; `open_world` has linings of every kind.

Tunnel i of a split has seed `SPLITS[split] + i` with i below a million, so that the splits share no seed. `train` is
for learning, `val` for choices, `test` for published figures.
"""

from __future__ import annotations

import dataclasses
import re

import numpy as np

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.loading import load_module
from subterra_jax.procedural import geometry, open_world
from subterra_jax.procedural.geometry import Alignment, ProceduralConfig, wall
from subterra_jax.tunnel.arrays import cut_pockets
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall
from subterra_jax.tunnel.tunnel import Tunnel, stack

__all__ = [
    "SPLITS",
    "Draw",
    "ProceduralConfig",
    "control",
    "default_lining",
    "draw",
    "expand",
    "family",
    "generate",
    "open_world",
    "plan",
    "seed_of",
]

LININGS = ("smooth", "pockets", "furnished")
_SIDES = {"left": 1.0, "right": -1.0}


@dataclasses.dataclass(frozen=True)
class Draw:
    """Numbers drawn for one tunnel. Fields not listed here have the meaning and unit of `ProceduralConfig`.

    Attributes:
        first_joint: Station of the first ring joint, m.
        rows: Walls on which the LiDAR plane crosses a row of recesses: `left`, `right` or both.
    """

    length: float
    width: float
    width_sd: float
    width_wave: float
    roughness: float
    correlation: float
    ring_pitch: float
    pocket_depth: float
    pocket_length: float
    pocket_offset: float
    pocket_missing: float
    bracket_spacing: float
    post_spacing: float
    first_joint: float
    rows: tuple[str, ...]


def draw(seed: int, config: ProceduralConfig | None = None) -> Draw:
    """Draw the numbers that describe the tunnel of a seed."""
    config = config or ProceduralConfig()
    config.check()
    rng = _streams(seed)[0]
    names = [field.name for field in dataclasses.fields(Draw) if field.name not in ("first_joint", "rows")]
    drawn = {name: float(rng.uniform(*getattr(config, name))) for name in names}
    rows = tuple(_SIDES) if rng.random() >= config.one_wall_share else (str(rng.choice(list(_SIDES))),)
    return Draw(**drawn, first_joint=float(rng.uniform(0.0, drawn["ring_pitch"])), rows=rows)


def plan(
    seed: int,
    config: ProceduralConfig | None = None,
    *,
    name: str | None = None,
    linings: tuple[str, ...] = LININGS,
) -> TunnelPlan:
    """Generate the tunnel of a seed.

    Args:
        seed: Seed, at least 0; `seed_of` gives the seeds of the splits.
        config: The family; `None` is the default one.
        name: Name of the tunnel; `None` names its seed.
        linings: Variants to make; each is the same whether made alone or with others.

    Returns:
        The tunnel, its mouth at the origin along x. With one version of NumPy, the same seed and config give the same
        tunnel to the bit.

    Raises:
        ValueError: The seed is negative, or the family has an empty range.
        SubterraError: Hardly any centreline of the family stays clear of itself.
    """
    config = config or ProceduralConfig()
    drawn = draw(seed, config)
    _, line_rng, wall_rng, pocket_rng, furniture_rng = _streams(seed)
    alignment = geometry.draw_alignment(line_rng, drawn.length, config)
    station = alignment.station
    at = np.linspace(0.0, drawn.length, round(drawn.length / config.wall_step) + 1)
    common = 0.5 * drawn.width + 0.5 * geometry.wander(wall_rng, at, drawn.width_sd, drawn.width_wave)
    distance = {side: common + geometry.wander(wall_rng, at, drawn.roughness, drawn.correlation) for side in _SIDES}
    smooth = {side: geometry.wall(alignment, sign, at, distance[side]) for side, sign in _SIDES.items()}
    recessed = _cut_recesses(alignment, drawn, at, distance, pocket_rng)
    nothing = np.zeros((0, 4))
    variants = {
        "smooth": lambda: Lining(smooth["left"], smooth["right"], nothing),
        "pockets": lambda: Lining(recessed["left"], recessed["right"], nothing),
        "furnished": lambda: Lining(
            recessed["left"], recessed["right"], _furniture(alignment, drawn, at, distance, furniture_rng)
        ),
    }
    return TunnelPlan(
        name=name or f"procedural seed {seed}",
        provenance="simulated",
        station=station,
        centre=alignment.position(station),
        tangent=alignment.tangent(station),
        elevation=np.zeros(len(station)),
        half_width=0.5 * np.interp(station, at, distance["left"] + distance["right"]),
        lidar_height=config.lidar_height,
        linings={lining: variants[lining]() for lining in linings},
        ring_pitch=drawn.ring_pitch,
    )


def _streams(seed: int) -> list[np.random.Generator]:
    """Return independent random generators of one seed, so that a change in one part leaves the others as they were."""
    if seed < 0:
        raise ValueError(f"the seed of a tunnel must not be negative, got {seed}")
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)]


def _cut_recesses(
    alignment: Alignment, drawn: Draw, at: np.ndarray, distance: dict[str, np.ndarray], rng: np.random.Generator
) -> dict[str, Wall]:
    """Cut the recesses into both walls."""
    joint = np.arange(drawn.first_joint, drawn.length, drawn.ring_pitch)
    made = {}
    for side, sign in _SIDES.items():
        start = geometry.recess_starts(
            rng, joint, drawn.pocket_offset, drawn.pocket_length, drawn.pocket_missing, drawn.length
        )
        start = start if side in drawn.rows else start[:0]
        cut = cut_pockets(at, distance[side], start, drawn.pocket_length, drawn.pocket_depth)
        made[side] = geometry.wall(alignment, sign, *cut)
    return made


def _furniture(
    alignment: Alignment, drawn: Draw, at: np.ndarray, distance: dict[str, np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """Return handrail posts along the left wall and cable brackets on the right; no robot fits behind them."""
    post = np.arange(rng.uniform(1.0, 1.0 + drawn.post_spacing), drawn.length - 1.0, drawn.post_spacing)
    rail = np.interp(post, at, distance["left"]) - geometry.RAIL
    bracket = np.arange(rng.uniform(1.0, 1.0 + drawn.bracket_spacing), drawn.length - 1.0, drawn.bracket_spacing)
    face = geometry.AIR - np.interp(bracket, at, distance["right"])
    return np.concatenate(
        [
            geometry.outlines(alignment, post, rail - geometry.POST, rail, geometry.POST),
            geometry.outlines(alignment, bracket, face, face + geometry.BRACKET, geometry.BRACKET),
        ]
    )


_CONTROL_LENGTH, _CONTROL_RADIUS, _CONTROL_HALF_WIDTH = 351.0, 300.0, 2.825
_CONTROL_GRID_STEP, _CONTROL_WALL_STEP, _CONTROL_LIDAR_HEIGHT = 0.25, 0.25, 0.7


def control() -> TunnelPlan:
    """Return the negative control: a bore in which no position along the axis looks different from any other.

    It is 351 m long and 5.65 m wide, with a bend of 300 m to the left, the lining `smooth` alone and no rings. Out of
    sight of the mouths (30 m) no LiDAR tells the station, so localisation cannot beat dead reckoning here.
    """
    bend = np.full(2, 1.0 / _CONTROL_RADIUS)
    alignment = Alignment(np.array([0.0, _CONTROL_LENGTH]), bend, _CONTROL_LENGTH, _CONTROL_GRID_STEP)
    station = alignment.station
    at = np.linspace(0.0, _CONTROL_LENGTH, round(_CONTROL_LENGTH / _CONTROL_WALL_STEP) + 1)
    left, right = (wall(alignment, side, at, np.full(len(at), _CONTROL_HALF_WIDTH)) for side in (1.0, -1.0))
    return TunnelPlan(
        name="control",
        provenance="simulated",
        station=station,
        centre=alignment.position(station),
        tangent=alignment.tangent(station),
        elevation=np.zeros(len(station)),
        half_width=np.full(len(station), _CONTROL_HALF_WIDTH),
        lidar_height=_CONTROL_LIDAR_HEIGHT,
        linings={"smooth": Lining(left, right, np.zeros((0, 4)))},
    )


SPLIT_SIZE = 1_000_000
SPLITS = {"train": 0, "val": SPLIT_SIZE, "test": 2 * SPLIT_SIZE}
_NAME = re.compile(r"procedural:(\w+):(\d+)")
_SEVERAL = re.compile(r"(procedural:\w+|(?:.+:)?open:[a-z:-]+):(\d+)-(\d+)")
_OPEN = re.compile(r"(?:(.+):)?(open:.*)")  # a tunnel of the open world; before it, a user's module that adds a kind


def seed_of(split: str, index: int) -> int:
    """Return the seed of a tunnel of a split.

    Raises:
        ValueError: The split does not exist, or has no such tunnel.
    """
    if split not in SPLITS:
        raise ValueError(f"no split {split!r} in the family; there are {', '.join(SPLITS)}")
    if not 0 <= index < SPLIT_SIZE:
        raise ValueError(f"tunnel {index} is not in split {split!r}, which has 0 to {SPLIT_SIZE - 1}")
    return SPLITS[split] + index


def family(
    split: str,
    n: int,
    lining: str = "pockets",
    *,
    first: int = 0,
    config: ProceduralConfig | None = None,
    reach: float = 30.0,
) -> Tunnel:
    """Generate the first tunnels of a split, in one stack.

    Args:
        split: `train`, `val` or `test`.
        n: Number of tunnels, at least 1.
        lining: `smooth`, `pockets` or `furnished`.
        first: Index of the first.
        config: The family; `None` is the default one.
        reach: Largest range that a LiDAR will ask for, m.

    Raises:
        ValueError: The split does not exist or has too few tunnels, or the family has an empty range.
        TunnelError: The lining does not exist.
    """
    if lining not in LININGS:
        raise TunnelError(f"the family has no lining {lining!r}; it has {', '.join(LININGS)}")
    seeds = [seed_of(split, first + i) for i in range(n)]
    return stack([Tunnel.from_plan(plan(s, config, linings=(lining,)), lining, reach=reach) for s in seeds])


def expand(name: str) -> list[str]:
    """Expand a name: `open:train:0-255` becomes the names of 256 tunnels, any other name stays one."""
    match = _SEVERAL.fullmatch(name)
    if match is None:
        return [name]
    first, last = int(match[2]), int(match[3])
    if last < first:
        raise TunnelError(f"no tunnels {name!r}: {last} comes before {first}")
    return [f"{match[1]}:{index}" for index in range(first, last + 1)]


def default_lining(name: str) -> str:
    """Return the variant of the walls that a generated tunnel has by default."""
    return "smooth" if name == "control" else open_world.VARIANTS[0] if _OPEN.fullmatch(name) else "pockets"


def generate(name: str, linings: tuple[str, ...] | None = None, solid: bool = False) -> TunnelPlan:
    """Generate a tunnel by its name: `control`, `procedural:SPLIT:INDEX`, or one of the open world.

    Args:
        name: The name; `FILE.py:open:KIND:SPLIT:INDEX` first runs a user's file, which registers the kind.
        linings: Variants to make, where the family has them; `None` for all.
        solid: Make the bore in three dimensions too, where the family has one.

    Raises:
        TunnelError: The tunnel does not exist.
        UserCodeError: The user's file cannot be run.
    """
    if name == "control":
        _choose_variants(name, linings, ("smooth",))
        return control()
    if match := _OPEN.fullmatch(name):
        if match[1]:
            load_module(match[1])
        return open_world.plan(match[2], variants=_choose_variants(name, linings, open_world.VARIANTS), solid=solid)
    match = _NAME.fullmatch(name)
    if match is None:
        raise TunnelError(
            f"no tunnel {name!r}; a generated one is called control, open:SPLIT:INDEX, open:KIND:SPLIT:INDEX or "
            f"procedural:SPLIT:INDEX, as in procedural:test:7"
        )
    try:
        return plan(seed_of(match[1], int(match[2])), name=name, linings=_choose_variants(name, linings, LININGS))
    except ValueError as error:
        raise TunnelError(f"no tunnel {name!r}: {error}") from error


def _choose_variants(name: str, wanted: tuple[str, ...] | None, there: tuple[str, ...]) -> tuple[str, ...]:
    """Return the wanted variants of a family.

    Raises:
        TunnelError: The family lacks one.
    """
    for lining in wanted or ():
        if lining not in there:
            raise TunnelError(f"tunnel {name!r} has no lining {lining!r}; it has {', '.join(there)}")
    return wanted or there
