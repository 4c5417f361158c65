"""Everything that one run measured, and the files it is written to."""

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.errors import ThroughputError
from benchmarks.throughput.peers.run import Peer
from benchmarks.throughput.timing import Speed
from benchmarks.throughput.variants import Variant
from subterra_jax.lidar.reference import Agreement

SCHEMA = "subterra.throughput/2"


@dataclass
class Result:
    """One run.

    Attributes:
        config: What was asked for.
        environment: Date, hardware and versions.
        tunnel: Name, length (m), lining and wall segments.
        n_beams: Beams of our LiDAR.
        exactness: Of our LiDAR; None where the gate was left out.
        speeds: Ours, one a batch size.
        floor: The same loop with nothing simulated.
        arithmetic: Steps/s at which brute force fills the device's lanes; None where those are not known.
        peers: Whoever else was measured, in the order of `--peers auto`.
        lengths: Tunnels of several lengths.
        linings: Several linings of the tunnel.
    """

    config: ThroughputConfig
    environment: dict[str, Any]
    tunnel: dict[str, Any]
    n_beams: int
    exactness: Agreement | None = None
    speeds: list[Speed] = field(default_factory=list)
    floor: list[Speed] = field(default_factory=list)
    arithmetic: float | None = None
    peers: list[Peer] = field(default_factory=list)
    lengths: list[Variant] = field(default_factory=list)
    linings: list[Variant] = field(default_factory=list)

    @property
    def gates(self) -> list[Agreement]:
        """Every comparison of the LiDAR with the reference."""
        every = [self.exactness, *(variant.exactness for variant in (*self.lengths, *self.linings))]
        return [gate for gate in every if gate is not None]

    def ratios(self, peer: Peer) -> dict[int, float]:
        """Our median over a peer's, by our batch size; at the same size, or over its only environment."""
        theirs = {speed.n_envs: speed.quartiles[1] for speed in peer.speeds}
        if peer.name == "mujoco":
            theirs = {speed.n_envs: theirs[1] for speed in self.speeds}
        return {s.n_envs: s.quartiles[1] / theirs[s.n_envs] for s in self.speeds if s.n_envs in theirs}


def as_json(result: Result) -> str:
    """The run as `throughput.json`."""
    content = {
        "schema": SCHEMA,
        "config": dataclasses.asdict(result.config),
        "environment": result.environment,
        "tunnel": result.tunnel,
        "exactness": None if result.exactness is None else dataclasses.asdict(result.exactness),
        "speed": [_speed(speed, result.n_beams) for speed in result.speeds],
        "floor": [_speed(speed, 0) for speed in result.floor],
        "arithmetic_floor": result.arithmetic,
        "peers": [_peer(peer, result) for peer in result.peers],
        "lengths": [_variant(variant, result.n_beams) for variant in result.lengths],
        "linings": [_variant(variant, result.n_beams) for variant in result.linings],
    }
    return json.dumps(content, indent=2, default=str, allow_nan=False) + "\n"


def prepare(folder: Path) -> None:
    """Makes the folder, before anything is measured.

    Raises:
        ThroughputError: It cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ThroughputError(f"{folder}: cannot be written ({error.strerror})") from error


def write(path: Path, content: bytes) -> None:
    """Writes a file under a temporary name and renames it."""
    fresh = path.with_name(f".{path.name}.partial")
    fresh.write_bytes(content)
    fresh.replace(path)


def _speed(speed: Speed, n_beams: int) -> dict[str, Any]:
    lower, median, upper = speed.quartiles
    rates = {
        "q1": lower,
        "median": median,
        "q3": upper,
        "ns_per_step": 1e9 / median,
        "rays_per_second": n_beams * median,
    }
    return dataclasses.asdict(speed) | rates


def _peer(peer: Peer, result: Result) -> dict[str, Any]:
    return dataclasses.asdict(peer) | {
        "speeds": [_speed(speed, peer.n_beams) for speed in peer.speeds],
        "ratios": {str(n_envs): ratio for n_envs, ratio in result.ratios(peer).items()},
    }


def _variant(variant: Variant, n_beams: int) -> dict[str, Any]:
    q1, median, q3 = variant.cost
    return dataclasses.asdict(variant) | {
        "speed": _speed(variant.speed, n_beams),
        "cost": {"q1": q1, "median": median, "q3": q3},
    }
