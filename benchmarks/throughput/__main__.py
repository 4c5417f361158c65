"""Speed of the batched environment and of its peers, measured together with the exactness of its LiDAR.

`python -m benchmarks.throughput --n 1024 4096 --lengths 351 3510 --linings smooth pockets furnished --out out/speed`
"""

import sys

from rich.console import Console

import subterra_jax as st
from benchmarks.command import run_main
from benchmarks.results import environment_facts, write_file
from benchmarks.throughput import report
from benchmarks.throughput.config import ThroughputConfig, check
from benchmarks.throughput.measure import arithmetic_floor, environment_loop, floor_loop, measure_exactness
from benchmarks.throughput.peers import Route, find_peers, measure_peer
from benchmarks.throughput.timing import Timing, measure
from benchmarks.throughput.variants import measure_lengths, measure_linings
from subterra_jax.host.files import require_folder

_progress = Console(stderr=True, highlight=False)


def run(config: ThroughputConfig) -> report.Result:
    """Measures everything that the settings ask for.

    Raises:
        SubterraError: A tunnel, lining, scene or peer is missing, or a setting is out of range.
        ValueError: No such task.
        FloatingPointError: An observation or a reward is not finite.
    """
    check(config)
    peers = find_peers(config.peers)
    tunnel = config.scene / "tunnel.npz" if config.scene is not None and config.tunnel is None else config.tunnel
    plan = st.load_tunnel(tunnel)
    env, params = st.make(config.task, plan, config.lining)
    # The comparison with the reference and the paper's route use the whole tunnel, whichever piece the task uses.
    whole = st.make("Subterra/Traverse-v0", plan, config.lining)[1]
    for lining in config.linings:
        plan.lining(lining)
    if config.out is not None:
        require_folder(config.out)
    timing = Timing(config.steps, config.repeats, config.seconds, config.seed)
    segments = len(plan.lining(config.lining).segments)
    facts = {"name": plan.name, "length": plan.length, "lining": config.lining, "segments": segments}
    result = report.Result(config, environment_facts(), facts, params.lidar.n_beams)
    result.arithmetic = arithmetic_floor(result.environment["device"], result.n_beams)
    if config.poses:
        _progress.print(f"exactness: {config.poses:,} poses")
        result.exactness = measure_exactness(plan, config.lining, whole, config.poses, config.seed)
    for n_envs in config.sizes():
        _progress.print(f"subterra: {n_envs:,} environments")
        loop = environment_loop(env, params, n_envs)
        result.speeds.append(measure(loop, n_envs, timing))
        result.floor.append(measure(floor_loop(loop), n_envs, timing))
    route = Route(plan, config.lining, whole, config.scene)
    for name, peer in peers.items():
        result.peers.append(measure_peer(name, peer, config.sizes(), route, timing, _progress.print))
    if config.lengths:
        _progress.print("lengths")
        result.lengths = measure_lengths(plan, config, timing)
    if config.linings:
        _progress.print("linings")
        result.linings = measure_linings(plan, config, timing)
    return result


def run_and_report(config: ThroughputConfig) -> int:
    """Measures, prints and writes; returns 1 where a number is not finite or a ray is wrong."""
    try:
        result = run(config)
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    # In a file or a pipe tables are not wrapped; a terminal knows its own width.
    report.show(result, Console(highlight=False, width=None if sys.stdout.isatty() else 120))
    if config.out is not None:
        write_file(config.out / "throughput.json", report.as_json(result).encode())
        write_file(config.out / "throughput.png", report.as_png(result))
    if any(gate.n_wrong for gate in result.gates):
        print("error: the LiDAR disagrees with the reference, so its speed counts for nothing", file=sys.stderr)
        return 1
    return 0


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 1 if the LiDAR is not exact, 2 for a user's mistake."""
    return run_main("throughput", ThroughputConfig, run_and_report, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
