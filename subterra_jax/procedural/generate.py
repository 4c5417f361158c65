"""One tunnel of a family: from a seed to a `TunnelPlan`, in float64 on the host."""

from __future__ import annotations

import dataclasses

import numpy as np

from subterra_jax.procedural import walls
from subterra_jax.procedural.alignment import Alignment, draw_alignment
from subterra_jax.procedural.config import ProceduralConfig
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall

LININGS = ("smooth", "pockets", "furnished")
_SIDES = {"left": 1.0, "right": -1.0}


@dataclasses.dataclass(frozen=True)
class Draw:
    """What was drawn for one tunnel; the fields mean what they mean in `ProceduralConfig`.

    Attributes:
        length: m.
        width: m.
        width_sd: m.
        width_wave: m.
        roughness: m.
        correlation: m.
        ring_pitch: m.
        pocket_depth: m.
        pocket_length: m.
        pocket_offset: m.
        pocket_missing: Share.
        bracket_spacing: m.
        post_spacing: m.
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
    """The numbers that describe the tunnel of a seed."""
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
    """The tunnel of a seed.

    Args:
        seed: Not negative; `seed_of` has the seeds of the splits.
        config: The family; None is the default one.
        name: Of the tunnel; None names its seed.
        linings: The variants to make; one made alone is the same as one made among others.

    Returns:
        The tunnel, its mouth at the origin along x. The same seed and config give the same tunnel, bit for bit, with
        one version of NumPy.

    Raises:
        ValueError: The seed is negative, or the family has an empty range.
        SubterraError: Hardly any centreline of the family stays clear of itself.
    """
    config = config or ProceduralConfig()
    drawn = draw(seed, config)
    _, course_rng, wall_rng, pocket_rng, furniture_rng = _streams(seed)
    alignment = draw_alignment(course_rng, drawn.length, config)
    station = alignment.station
    at = np.linspace(0.0, drawn.length, round(drawn.length / config.wall_step) + 1)
    common = 0.5 * drawn.width + 0.5 * walls.wander(wall_rng, at, drawn.width_sd, drawn.width_wave)
    distance = {side: common + walls.wander(wall_rng, at, drawn.roughness, drawn.correlation) for side in _SIDES}
    smooth = {side: walls.wall(alignment, sign, at, distance[side]) for side, sign in _SIDES.items()}
    recessed = _recessed(alignment, drawn, at, distance, pocket_rng)
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
    """Independent sources of randomness of one seed, so that a change in one part leaves the others as they were."""
    if seed < 0:
        raise ValueError(f"the seed of a tunnel must not be negative, got {seed}")
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)]


def _recessed(
    alignment: Alignment, drawn: Draw, at: np.ndarray, distance: dict[str, np.ndarray], rng: np.random.Generator
) -> dict[str, Wall]:
    """Both walls, those with a row with its recesses."""
    joint = np.arange(drawn.first_joint, drawn.length, drawn.ring_pitch)
    made = {}
    for side, sign in _SIDES.items():
        start = walls.recess_starts(
            rng, joint, drawn.pocket_offset, drawn.pocket_length, drawn.pocket_missing, drawn.length
        )
        start = start if side in drawn.rows else start[:0]
        cut = walls.recessed(at, distance[side], start, drawn.pocket_length, drawn.pocket_depth)
        made[side] = walls.wall(alignment, sign, *cut)
    return made


def _furniture(
    alignment: Alignment, drawn: Draw, at: np.ndarray, distance: dict[str, np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """Posts of a handrail along the left wall, cable brackets on the right one: so near that no robot fits behind."""
    post = np.arange(rng.uniform(1.0, 1.0 + drawn.post_spacing), drawn.length - 1.0, drawn.post_spacing)
    rail = np.interp(post, at, distance["left"]) - walls.RAIL
    bracket = np.arange(rng.uniform(1.0, 1.0 + drawn.bracket_spacing), drawn.length - 1.0, drawn.bracket_spacing)
    face = walls.AIR - np.interp(bracket, at, distance["right"])
    return np.concatenate(
        [
            walls.outlines(alignment, post, rail - walls.POST, rail, walls.POST),
            walls.outlines(alignment, bracket, face, face + walls.BRACKET, walls.BRACKET),
        ]
    )
