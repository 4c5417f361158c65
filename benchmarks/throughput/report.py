"""One run's results: tables on a terminal, `throughput.json` and the figure."""

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from benchmarks.results import constants_facts, png_bytes
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.peers import ROUTE, Peer
from benchmarks.throughput.timing import Speed
from benchmarks.throughput.variants import Variant
from subterra_jax.lidar.reference import Agreement

SCHEMA = "subterra.throughput/2"


@dataclass
class Result:
    """All measurements of one run.

    Attributes:
        config: Settings of the run.
        environment: Date, hardware and versions.
        tunnel: Name, length (m), lining and wall segments.
        n_beams: Beams of our LiDAR.
        exactness: Comparison of our LiDAR with the reference; `None` if skipped.
        speeds: Our speeds, one for each batch size.
        floor: Speeds of the same loop with nothing simulated.
        arithmetic: Steps/s at which brute force fills the device's lanes; `None` where those are not known.
        peers: Other environments, in the order of `--peers auto`.
        lengths: Speeds in tunnels of several lengths.
        linings: Speeds in several linings of the tunnel.
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
        """Returns every comparison of the LiDAR with the reference."""
        every = [self.exactness, *(variant.exactness for variant in (*self.lengths, *self.linings))]
        return [gate for gate in every if gate is not None]

    def ratios(self, peer: Peer) -> dict[int, float]:
        """Returns our median over a peer's by batch size: at the same size, or over the route's only environment."""
        theirs = {speed.n_envs: speed.quartiles[1] for speed in peer.speeds}
        if peer.name == ROUTE:
            theirs = {speed.n_envs: theirs[1] for speed in self.speeds}
        return {s.n_envs: s.quartiles[1] / theirs[s.n_envs] for s in self.speeds if s.n_envs in theirs}


def as_json(result: Result) -> str:
    """Returns the content of `throughput.json`."""
    content = {
        "schema": SCHEMA,
        "config": dataclasses.asdict(result.config),
        "environment": result.environment,
        **constants_facts(),
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


def _speed(speed: Speed, n_beams: int) -> dict[str, Any]:
    lower, median, upper = speed.quartiles
    rates = {"q1": lower, "median": median, "q3": upper}
    return {**dataclasses.asdict(speed), **rates, "ns_per_step": 1e9 / median, "rays_per_second": n_beams * median}


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


def show(result: Result, console: Console) -> None:
    """Prints speeds, ratios, variants and the comparison with the reference."""
    facts = result.environment
    console.print(
        f"{facts['device']}, {facts['cpu_cores']} cores, jax {facts['jax']}, {facts['date']}; "
        f"{result.config.task} in {result.tunnel['name']}, {result.tunnel['lining']}",
        highlight=False,
    )
    console.print(_speeds(result))
    for peer in result.peers:
        for size, reason in peer.left_out.items():
            console.print(f"{peer.name}, {size}: {reason}", highlight=False)
        if peer.speeds:
            console.print(f"{peer.name} {peer.version}: {peer.about}", highlight=False)
    if any(peer.speeds for peer in result.peers):
        console.print(_ratios(result))
    for title, variants in (("length", result.lengths), ("lining", result.linings)):
        if variants:
            console.print(_variants(title, variants))
    if result.exactness is not None:
        console.print(gate_line(result.exactness), highlight=False)


def gate_line(gate: Agreement) -> str:
    """Returns the comparison with the reference in one line."""
    return (
        f"LiDAR against float64 brute force, {gate.n_rays:,} rays: largest error {gate.max_error * 1e3:.3f} mm, "
        f"{gate.n_ambiguous} at an edge within rounding, {gate.n_wrong} wrong"
    )


def _speeds(result: Result) -> Table:
    table = _table(
        "environment steps", ("who", "envs", "median /s", "quartiles", "ns per step", "rays /s", "compile, s")
    )
    measured: list[tuple[str, int, Iterable[Speed]]] = [("subterra", result.n_beams, result.speeds)]
    measured += [(peer.name, peer.n_beams, peer.speeds) for peer in result.peers]
    for name, n_beams, speeds in [*measured, ("floor", 0, result.floor)]:
        for speed in speeds:
            _, median, _ = speed.quartiles
            rays = format_rate(n_beams * median) if n_beams else "-"
            table.add_row(
                name, f"{speed.n_envs:,}", format_rate(median), _quartiles(speed), f"{1e9 / median:,.1f}", rays,
                f"{speed.compile_seconds:.1f}",
            )  # fmt: skip
        table.add_section()
    return table


def _ratios(result: Result) -> Table:
    peers = [peer for peer in result.peers if peer.speeds]
    table = _table("times as fast as", ("envs", *(peer.name for peer in peers)))
    ratios = [result.ratios(peer) for peer in peers]
    for speed in result.speeds:
        cells = [f"{each[speed.n_envs]:,.3g}" if speed.n_envs in each else "-" for each in ratios]
        table.add_row(f"{speed.n_envs:,}", *cells)
    return table


def _variants(title: str, variants: list[Variant]) -> Table:
    names = (title, "segments", "envs", "median /s", "ns per step", "cost", "quartiles", "error, mm", "wrong")
    table = _table("cost of a step", names)
    for variant in variants:
        lower, median, upper = variant.cost
        rate, gate = variant.speed.quartiles[1], variant.exactness
        table.add_row(
            variant.name, f"{variant.n_segments:,}", f"{variant.speed.n_envs:,}", format_rate(rate),
            f"{1e9 / rate:,.1f}", f"{median:.3f}", f"{lower:.3f} to {upper:.3f}",
            *(("-", "-") if gate is None else (f"{gate.max_error * 1e3:.3f}", str(gate.n_wrong))),
        )  # fmt: skip
    return table


def _table(title: str, names: tuple[str, ...]) -> Table:
    table = Table(title=title)
    for name in names:
        table.add_column(name, justify="left" if name == "who" else "right", no_wrap=name != title)
    return table


def _quartiles(speed: Speed) -> str:
    lower, _, upper = speed.quartiles
    return f"{format_rate(lower)} to {format_rate(upper)}"


def format_rate(value: float) -> str:
    """Returns a rate with four digits, in thousands or millions if it is large."""
    for unit, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= unit:
            return f"{value / unit:.4g}{suffix}"
    return f"{value:.4g}"


# Colours that colour-blind readers can tell apart (after Okabe and Ito); markers differ too.
_OURS, _GREY = "#0072b2", "#777777"
_PEERS = {"jaxnav": ("#d55e00", "s"), "gymnax": ("#009e73", "^"), "mujoco": ("#e69f00", "D")}
_LABELS = {
    "jaxnav": "JaxNav, {beams} beams",
    "gymnax": "gymnax Pendulum, no sensor",
    "mujoco": "paper's route, one environment",
}


def draw(result: Result) -> Figure:
    """Draws steps per second against batch size; lines join medians, shades span the quartiles."""
    figure, axes = plt.subplots(figsize=(7.5, 5), layout="constrained")
    _line(axes, result.speeds, f"Subterra, {result.n_beams} beams", _OURS, "o", width=2.0)
    for peer in result.peers:
        colour, marker = _PEERS[peer.name]
        label = _LABELS[peer.name].format(beams=peer.n_beams)
        _line(axes, peer.speeds, label, colour, marker)
        if peer.name == ROUTE and peer.speeds:
            axes.axhline(peer.speeds[0].quartiles[1], color=colour, lw=0.8, ls=":")
    _line(axes, result.floor, "floor in time: same loop, nothing simulated", _GREY, "", ls="--")
    if result.arithmetic is not None:
        axes.axhline(result.arithmetic, color=_GREY, lw=1.0, ls=":", label="brute force filling all lanes")
    axes.set(xscale="log", yscale="log", xlabel="environments in the batch", ylabel="environment steps per second")
    sizes = [speed.n_envs for speed in result.speeds]
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes], rotation=30)
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper left")
    facts, timing = result.environment, result.config
    axes.set_title(
        f"{facts['device']}, jax {facts['jax']}; {timing.task}, {result.tunnel['name']}, {result.tunnel['lining']}; "
        f"median of {timing.repeats}",
        fontsize=9,
    )
    return figure


def as_png(result: Result) -> bytes:
    """Returns the figure as a PNG file."""
    return png_bytes(draw(result), dpi=150)


def _line(
    axes: Axes, speeds: list[Speed], label: str, colour: str, marker: str, width: float = 1.3, ls: str = "-"
) -> None:
    if not speeds:
        return
    size = [speed.n_envs for speed in speeds]
    lower, median, upper = np.array([speed.quartiles for speed in speeds]).T
    axes.plot(size, median, color=colour, marker=marker, ms=5, lw=width, ls=ls, label=label)
    axes.fill_between(size, lower, upper, color=colour, alpha=0.2, lw=0)
