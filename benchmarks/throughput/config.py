"""What to measure, and the sizes that a machine is measured at where none are given."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax

from benchmarks.throughput.errors import ThroughputError

SIZES = (1, 16, 256, 1024, 4096, 16_384, 65_536, 262_144)
_MOST_ON_CPU = 4096
# Where lengths and linings are compared: large enough that a step is work, not overhead.
_STUDIED_ON_CPU, _STUDIED = 1024, 65_536

PeerChoice = Literal["auto", "none", "jaxnav", "gymnax", "mujoco"]


@dataclass(frozen=True)
class ThroughputConfig:
    """What to measure.

    Attributes:
        n: Environments in a batch; each size is measured. None given: 1 to 262,144, on a CPU to 4,096.
        peers: Who else is measured: `auto` (everybody installed), `none`, or names. One that is named must be there.
        task: Id of the task.
        tunnel: Tunnel file, or the name of a packaged one; the packaged default if not given.
        scene: Scene folder for the paper's route. It brings its own `tunnel.npz` unless `tunnel` is given. Without it,
            MuJoCo gets the tunnel's walls, extruded.
        lining: Variant of the walls.
        lengths: Lengths of tunnel to compare, m; a tunnel too short is continued by itself, mirrored.
        linings: Variants of the walls to compare.
        study_n: Environments in a batch for those comparisons; None is 65,536, on a CPU 1,024.
        steps: Steps in one timed call, all within one `lax.scan`.
        repeats: Timed calls.
        seconds: Time to spend on the calls of one size, s; where it would take longer, a call has fewer steps.
        poses: Random poses at which the LiDAR is compared with float64 brute force; 0 leaves the gate out.
        seed: Seed of actions, environments and poses.
        out: Folder to write `throughput.json` and `throughput.png` into.
    """

    n: tuple[int, ...] = ()
    peers: tuple[PeerChoice, ...] = ("auto",)
    task: str = "Subterra/Traverse-v0"
    tunnel: str | None = None
    scene: Path | None = None
    lining: str = "pockets"
    lengths: tuple[float, ...] = ()
    linings: tuple[str, ...] = ()
    study_n: int | None = None
    steps: int = 100
    repeats: int = 20
    seconds: float = 30.0
    poses: int = 10_000
    seed: int = 0
    out: Path | None = None

    def sizes(self) -> tuple[int, ...]:
        """Batch sizes to measure on this machine, growing."""
        if self.n:
            return tuple(sorted(set(self.n)))
        return tuple(size for size in SIZES if not _on_cpu() or size <= _MOST_ON_CPU)

    def studied(self) -> int:
        """Batch size at which lengths and linings are compared on this machine."""
        if self.study_n is not None:
            return self.study_n
        return _STUDIED_ON_CPU if _on_cpu() else _STUDIED


def check(config: ThroughputConfig) -> None:
    """Refuses what cannot be measured.

    Raises:
        ThroughputError: Naming the option and its value.
    """
    for name, least in (("steps", 1), ("repeats", 1), ("poses", 0), ("seed", 0)):
        if getattr(config, name) < least:
            raise ThroughputError(f"--{name} must be at least {least}, got {getattr(config, name)}")
    for size in (*config.n, config.studied()):
        if size < 1:
            raise ThroughputError(f"a batch holds at least 1 environment, got {size}")
    for name, value in (("seconds", config.seconds), *(("lengths", length) for length in config.lengths)):
        if not 0.0 < value < math.inf:
            raise ThroughputError(f"--{name} must be positive, got {value}")
    if len(config.peers) > 1 and {"auto", "none"} & set(config.peers):
        raise ThroughputError(f"--peers takes auto, none, or names, got {' '.join(config.peers)}")


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"
