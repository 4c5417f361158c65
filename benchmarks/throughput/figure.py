"""Steps per second against batch size: ours, the peers, and the floor under them all."""

import io

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.throughput.result import Result
from benchmarks.throughput.timing import Speed

# Told apart by colour-blind readers (after Okabe and Ito), and by their markers.
_OURS, _GREY = "#0072b2", "#777777"
_PEERS = {"jaxnav": ("#d55e00", "s"), "gymnax": ("#009e73", "^"), "mujoco": ("#e69f00", "D")}
_LABELS = {
    "jaxnav": "JaxNav, {beams} beams",
    "gymnax": "gymnax Pendulum, no sensor",
    "mujoco": "paper's route, one environment",
}


def draw(result: Result) -> Figure:
    """The figure; lines join medians, shades span the quartiles."""
    figure, axes = plt.subplots(figsize=(7.5, 5), layout="constrained")
    _line(axes, result.speeds, f"Subterra, {result.n_beams} beams", _OURS, "o", width=2.0)
    for peer in result.peers:
        colour, marker = _PEERS[peer.name]
        label = _LABELS[peer.name].format(beams=peer.n_beams)
        _line(axes, peer.speeds, label, colour, marker)
        if peer.name == "mujoco" and peer.speeds:
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
    """The figure as a picture."""
    figure, buffer = draw(result), io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    plt.close(figure)
    return buffer.getvalue()


def _line(
    axes: Axes, speeds: list[Speed], label: str, colour: str, marker: str, width: float = 1.3, ls: str = "-"
) -> None:
    if not speeds:
        return
    size = [speed.n_envs for speed in speeds]
    lower, median, upper = np.array([speed.quartiles for speed in speeds]).T
    axes.plot(size, median, color=colour, marker=marker, ms=5, lw=width, ls=ls, label=label)
    axes.fill_between(size, lower, upper, color=colour, alpha=0.2, lw=0)
