"""One run's results: tables, and records."""

from dataclasses import dataclass, field
from typing import Any

from benchmarks.records import Record, measured
from benchmarks.reference import Agreement
from benchmarks.results import markdown_table
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.loops import N_BEAMS, Peer
from benchmarks.throughput.timing import Speed
from subterra_jax.parts.spatial_lidar import SENSORS

PLANAR = SENSORS[0]


@dataclass
class Result:
    """All measurements of one run."""

    config: ThroughputConfig  # Settings of the run
    environment: dict[str, Any]  # Date, hardware and versions
    tunnel: dict[str, Any]  # Name, length (m), lining and wall segments
    n_beams: int  # Beams of our LiDAR
    exactness: Agreement | None = None  # Comparison of our LiDAR with the reference; `None` if skipped
    speeds: list[Speed] = field(default_factory=list)  # Our speeds, one for each batch size
    peers: list[Peer] = field(default_factory=list)  # Other environments

    def ratios(self, peer: Peer) -> dict[int, float]:
        """Returns our median over a peer's by batch size."""
        theirs = {speed.n_envs: speed.quartiles[1] for speed in peer.speeds}
        return {s.n_envs: s.quartiles[1] / theirs[s.n_envs] for s in self.speeds if s.n_envs in theirs}


def as_text(result: Result) -> str:
    """Returns speeds, ratios and the comparison with the reference as lines and Markdown tables."""
    facts, config = result.environment, result.config
    who = [("subterra", result.n_beams, result.speeds), *((peer.name, N_BEAMS, peer.speeds) for peer in result.peers)]
    rows = []
    for name, n_beams, speeds in who:
        for speed in speeds:
            lower, median, upper = map(format_rate, speed.quartiles)
            per_step, rays = 1e9 / speed.quartiles[1], format_rate(n_beams * speed.quartiles[1])
            rows.append((name, f"{speed.n_envs:,}", median, f"{lower} to {upper}", f"{per_step:,.1f}", rays,
                         f"{speed.compile_seconds:.1f}"))  # fmt: skip
    lines = [
        f"{facts['device']}, {facts['cpu_cores']} cores, jax {facts['jax']}, {facts['date']}; "
        f"{config.task} in {result.tunnel['name']}, {result.tunnel['lining']}",
        markdown_table(("who", "envs", "median /s", "quartiles", "ns per step", "rays /s", "compile, s"), rows),
    ]
    for peer in result.peers:
        lines += [f"{peer.name}, {size}: {reason}" for size, reason in peer.left_out.items()]
        times = [f"{ratio:,.3g} at {n_envs:,}" for n_envs, ratio in result.ratios(peer).items()]
        lines += [f"{peer.name} {peer.version}: {peer.about}; times as fast: {', '.join(times)}"] if times else []
    if (gate := result.exactness) is not None:
        lines.append(
            f"LiDAR against float64 brute force, {gate.n_rays:,} rays: largest error {gate.max_error * 1e3:.3f} mm, "
            f"{gate.n_ambiguous} at an edge within rounding, {gate.n_wrong} wrong"
        )
    return "\n".join(lines)


def format_rate(value: float) -> str:
    """Returns a rate with four digits, in thousands or millions if it is large."""
    for unit, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= unit:
            return f"{value / unit:.4g}{suffix}"
    return f"{value:.4g}"


def records_of(result: Result) -> list[Record]:
    """Return the records of a measurement: `speed/cpu-N` or `speed/step-N` in one tunnel, `speed/K-tunnels` in many."""
    config, count = result.config, result.tunnel["tunnels"]
    command = f"benchmarks.throughput {_words(result)}--out out/speed"
    where = f"{config.task.removeprefix('Subterra/')}, {result.tunnel['name']}"
    found = []
    if result.exactness is not None and count == 1:
        error, rays = 1e3 * result.exactness.max_error, result.exactness.n_rays
        found.append(
            measured("speed/lidar-error", round(error, 2), "mm", command, split=where, n=rays, bound="at most")
        )
    for speed in result.speeds:
        kind = "cpu" if result.environment["platform"] == "cpu" else "step"
        what = "" if config.sensor == PLANAR else f"-{config.sensor}"
        one = f"{kind}{what}{'' if config.texture is None else '-texture'}-{speed.n_envs}"
        name = one if count == 1 else f"{count}-tunnels" + ("" if speed.n_envs == 65_536 else f"-{speed.n_envs}")
        rate = round(1e-6 * speed.quartiles[1], 3)
        found.append(measured(f"speed/{name}", rate, "M steps/s", command, split=where, bound="at least"))
    return found


def _words(result: Result) -> str:
    """Return the options that a measurement again needs."""
    config = result.config
    tunnel = f"--tunnel {config.tunnel} --copies {config.copies} " if config.tunnel else ""
    shown = "" if config.sensor == PLANAR else f"--sensor {config.sensor} "
    shown += "" if config.texture is None else f"--texture {config.texture:g} "
    sizes = " ".join(map(str, config.sizes()))
    return f"--task {config.task} {tunnel}{shown}--n {sizes} --poses {config.poses} --peers none "
