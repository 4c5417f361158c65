"""What was measured, as tables on a terminal."""

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

from benchmarks.throughput.result import Result
from benchmarks.throughput.timing import Speed
from benchmarks.throughput.variants import Variant
from subterra_jax.lidar.reference import Agreement


def show(result: Result, console: Console) -> None:
    """Prints speeds, ratios, variants and the gate."""
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
    """The gate in one line."""
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
            rays = short(n_beams * median) if n_beams else "-"
            table.add_row(
                name, f"{speed.n_envs:,}", short(median), _quartiles(speed), f"{1e9 / median:,.1f}", rays,
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
            variant.name, f"{variant.n_segments:,}", f"{variant.speed.n_envs:,}", short(rate), f"{1e9 / rate:,.1f}",
            f"{median:.3f}", f"{lower:.3f} to {upper:.3f}",
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
    return f"{short(lower)} to {short(upper)}"


def short(value: float) -> str:
    """A rate to four digits, in thousands or millions where it is large."""
    for unit, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= unit:
            return f"{value / unit:.4g}{suffix}"
    return f"{value:.4g}"
