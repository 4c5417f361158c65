"""Splits of the family, and tunnels by name.

Tunnel i of a split has seed `SPLITS[split] + i` with i below a million, so that the splits share no seed. `train` is
for learning, `val` for choices, `test` for figures that are published.
"""

import re

from subterra_jax.errors import TunnelError
from subterra_jax.procedural.config import ProceduralConfig
from subterra_jax.procedural.control import control
from subterra_jax.procedural.generate import LININGS, plan
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.stack import stack

SPLIT_SIZE = 1_000_000
SPLITS = {"train": 0, "val": SPLIT_SIZE, "test": 2 * SPLIT_SIZE}
_NAME = re.compile(r"procedural:(\w+):(\d+)")
_SEVERAL = re.compile(r"(procedural:\w+):(\d+)-(\d+)")


def seed_of(split: str, index: int) -> int:
    """Seed of a tunnel of a split.

    Raises:
        ValueError: There is no such split, or no such tunnel in it.
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
    """The first tunnels of a split, in one stack.

    Args:
        split: `train`, `val` or `test`.
        n: How many, at least 1.
        lining: `smooth`, `pockets` or `furnished`.
        first: Index of the first.
        config: The family; None is the default one.
        reach: Largest range that a LiDAR will ask for, m.

    Raises:
        ValueError: There is no such split, not so many tunnels in it, or the family has an empty range.
        TunnelError: There is no such lining.
    """
    if lining not in LININGS:
        raise TunnelError(f"the family has no lining {lining!r}; it has {', '.join(LININGS)}")
    seeds = [seed_of(split, first + i) for i in range(n)]
    return stack([Tunnel.from_plan(plan(s, config, linings=(lining,)), lining, reach=reach) for s in seeds])


def expand(name: str) -> list[str]:
    """The names that a name stands for: those of `procedural:train:0-255` are its 256 tunnels, others stand for one."""
    match = _SEVERAL.fullmatch(name)
    if match is None:
        return [name]
    first, last = int(match[2]), int(match[3])
    if last < first:
        raise TunnelError(f"no tunnels {name!r}: {last} comes before {first}")
    return [f"{match[1]}:{index}" for index in range(first, last + 1)]


def named(name: str) -> TunnelPlan:
    """A generated tunnel by its name: `control`, or `procedural:SPLIT:INDEX`.

    Raises:
        TunnelError: There is no such tunnel.
    """
    if name == "control":
        return control()
    match = _NAME.fullmatch(name)
    if match is None:
        raise TunnelError(
            f"no tunnel {name!r}; a generated one is called control or procedural:SPLIT:INDEX, as in procedural:test:7"
        )
    try:
        return plan(seed_of(match[1], int(match[2])), name=name)
    except ValueError as error:
        raise TunnelError(f"no tunnel {name!r}: {error}") from error
