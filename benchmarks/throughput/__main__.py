"""Speed of the batched environment and of its peers, measured together with the exactness of its LiDAR.

`python -m benchmarks.throughput --n 1024 4096 --lengths 351 3510 --linings smooth pockets furnished --out out/speed`
"""

import sys

import tyro
from rich.console import Console

import subterra_jax as st
from benchmarks.command import status
from benchmarks.throughput import figure, report, result
from benchmarks.throughput.config import ThroughputConfig, check
from benchmarks.throughput.exactness import measure_exactness
from benchmarks.throughput.facts import environment_facts
from benchmarks.throughput.measure import arithmetic_floor, environment_loop, floor_loop
from benchmarks.throughput.peers.run import Route, measure_peer, wanted
from benchmarks.throughput.timing import Timing, measure
from benchmarks.throughput.variants import measure_lengths, measure_linings
from scene.arguments import parse

_progress = Console(stderr=True, highlight=False)


def run(config: ThroughputConfig) -> result.Result:
    """Measures everything that was asked for.

    Raises:
        SubterraError: Something that was asked for is not there.
        ValueError: No such task.
        FloatingPointError: An observation or a reward was not finite.
    """
    check(config)
    peers = wanted(config.peers)
    tunnel = config.scene / "tunnel.npz" if config.scene is not None and config.tunnel is None else config.tunnel
    plan = st.load_tunnel(tunnel)
    env, params = st.make(config.task, plan, config.lining)
    # The gate and the paper's route look at the whole tunnel, whichever piece of it the task uses.
    whole = st.make("Subterra/Traverse-v0", plan, config.lining)[1]
    for lining in config.linings:
        plan.lining(lining)
    if config.out is not None:
        result.prepare(config.out)
    timing = Timing(config.steps, config.repeats, config.seconds, config.seed)
    segments = len(plan.lining(config.lining).segments)
    facts = {"name": plan.name, "length": plan.length, "lining": config.lining, "segments": segments}
    found = result.Result(config, environment_facts(), facts, params.lidar.n_beams)
    found.arithmetic = arithmetic_floor(found.environment["device"], found.n_beams)
    if config.poses:
        _progress.print(f"exactness: {config.poses:,} poses")
        found.exactness = measure_exactness(plan, config.lining, whole, config.poses, config.seed)
    for n_envs in config.sizes():
        _progress.print(f"subterra: {n_envs:,} environments")
        loop = environment_loop(env, params, n_envs)
        found.speeds.append(measure(loop, n_envs, timing))
        found.floor.append(measure(floor_loop(loop), n_envs, timing))
    route = Route(plan, config.lining, whole, config.scene)
    for name, module in peers.items():
        found.peers.append(measure_peer(name, module, config.sizes(), route, timing, _progress.print))
    if config.lengths:
        _progress.print("lengths")
        found.lengths = measure_lengths(plan, config, timing)
    if config.linings:
        _progress.print("linings")
        found.linings = measure_linings(plan, config, timing)
    return found


def main() -> int:
    """Entry point; the status is 1 if the LiDAR is not exact, and 2 for a user's mistake."""
    config = parse(
        lambda words: tyro.cli(
            ThroughputConfig, args=words, prog="python -m benchmarks.throughput", description=__doc__
        )
    )
    return status(lambda: tell(config))


def tell(config: ThroughputConfig) -> int:
    """Measures, prints, writes; the status is 1 where a number is not finite or a ray is wrong."""
    try:
        found = run(config)
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    # Into a file or a pipe tables go unbroken; a terminal knows its own width.
    report.show(found, Console(highlight=False, width=None if sys.stdout.isatty() else 120))
    if config.out is not None:
        result.write(config.out / "throughput.json", result.as_json(found).encode())
        result.write(config.out / "throughput.png", figure.as_png(found))
    if any(gate.n_wrong for gate in found.gates):
        print("error: the LiDAR disagrees with the reference, so its speed counts for nothing", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
