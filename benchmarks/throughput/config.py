"""Settings of a throughput run, and the batch sizes of a machine where none are given."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax

from benchmarks.command import BenchmarkError
from subterra_jax.parts.spatial_lidar import SENSORS

SIZES = (1, 16, 256, 1024, 4096, 16_384, 65_536, 262_144)
_MOST_ON_CPU = 4096


@dataclass(frozen=True)
class ThroughputConfig:
    """Settings of a throughput run.

    Attributes:
        n: Batch sizes to measure; 1 to 262,144 if not given, on a CPU to 4,096.
        peers: JaxNav beside ours: `auto` (where it is installed), `jaxnav`, or `none`.
        task: Task id.
        tunnel: Tunnel file or name; the first that the task has by itself if not given. Several names, as
            `open:cast:train:0-9` or with commas between: each episode draws one of them.
        copies: Copies of each tunnel, in memory of their own.
        lining: Variant of the walls; the tunnel's usual one if not given.
        sensor: LiDAR, the planar one or as `spin16x64`.
        texture: Dial of the walls' texture, 0 to 1; where it is given, intensities are observed.
        steps: Steps in one timed call, all within one `lax.scan`.
        repeats: Timed calls.
        seconds: Time limit for all calls of one size, s; a call gets fewer steps to keep to it.
        poses: Random poses at which the planar LiDAR is compared with float64 brute force; 0 skips the comparison.
        seed: Seed for actions, environments and poses.
        out: Output folder for `records.json`.
    """

    n: tuple[int, ...] = ()
    peers: Literal["auto", "none", "jaxnav"] = "auto"
    task: str = "Subterra/Traverse-v1"
    tunnel: str | None = None
    copies: int = 1
    lining: str | None = None
    sensor: str = SENSORS[0]
    texture: float | None = None
    steps: int = 100
    repeats: int = 20
    seconds: float = 30.0
    poses: int = 10_000
    seed: int = 0
    out: Path | None = None

    def sizes(self) -> tuple[int, ...]:
        """Returns the batch sizes to measure on this machine, in increasing order."""
        if self.n:
            return tuple(sorted(set(self.n)))
        return tuple(size for size in SIZES if jax.default_backend() != "cpu" or size <= _MOST_ON_CPU)


def check(config: ThroughputConfig) -> None:
    """Refuses settings that cannot be measured.

    Raises:
        BenchmarkError: An option is out of range; the message names it with its value.
    """
    for name, least in (("copies", 1), ("steps", 1), ("repeats", 1), ("poses", 0), ("seed", 0)):
        if getattr(config, name) < least:
            raise BenchmarkError(f"--{name} must be at least {least}, got {getattr(config, name)}")
    for size in config.n:
        if size < 1:
            raise BenchmarkError(f"a batch holds at least 1 environment, got {size}")
    if not 0.0 < config.seconds < math.inf:
        raise BenchmarkError(f"--seconds must be positive, got {config.seconds}")
