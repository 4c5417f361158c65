"""Speed of the batched environment and of its peers, measured together with the exactness of its LiDAR.

`python -m benchmarks.throughput --n 1024 4096 --out out/speed`
`python -m benchmarks.throughput --task Subterra/StopAt-v1 --tunnel open:train:0-999 --sensor spin16x64 --n 65536`
"""

import sys
from typing import Any

import numpy as np
from rich.console import Console

import subterra_jax as st
from benchmarks.command import BenchmarkError, run_main
from benchmarks.records import write_records
from benchmarks.reference import measure_exactness, measure_exactness_of_many
from benchmarks.results import environment_facts, write_file
from benchmarks.throughput import report
from benchmarks.throughput.config import ThroughputConfig, check
from benchmarks.throughput.loops import environment_loop, measure_jaxnav, require_jaxnav
from benchmarks.throughput.timing import Timing, measure
from subterra_jax.host.files import require_folder
from subterra_jax.tasks import first_tunnel
from train import tunnels

_WHOLE = "Subterra/Traverse-v1"  # whose piece is the whole tunnel
_COMPARED = 8  # tunnels of several in which the LiDAR is compared
_progress = Console(stderr=True, highlight=False, emoji=False)


def run(config: ThroughputConfig) -> report.Result:
    """Measures everything that the settings ask for.

    Raises:
        SubterraError: A tunnel, lining or peer is missing, or a setting is out of range.
        ValueError: No such task.
        FloatingPointError: An observation or a reward is not finite.
    """
    check(config)
    if config.out is not None:
        require_folder(config.out)
    names = [config.tunnel] if config.tunnel is None else tunnels.names_of(config.tunnel)
    return run_one(config) if len(names) * config.copies == 1 else run_many(config, names)


def run_one(config: ThroughputConfig) -> report.Result:
    """Measures in one tunnel, beside JaxNav."""
    if config.peers == "jaxnav":
        require_jaxnav()
    plan = st.load_tunnel(config.tunnel or first_tunnel(config.task))
    lining = config.lining or plan.default_lining
    env, params = st.make(config.task, plan, lining, sensor=config.sensor)
    segments = len(plan.lining(lining).segments)
    facts = {"name": plan.name, "length": plan.length, "lining": lining, "segments": segments}
    result, timing = _begin(config, facts, params)
    if config.poses:
        _progress.print(f"exactness: {config.poses:,} poses")
        # The comparison with the reference uses the whole tunnel, whichever piece the task uses.
        whole = st.make(_WHOLE, plan, lining)[1]
        result.exactness = measure_exactness(plan, lining, whole, config.poses, config.seed)
    _measure_speeds(result, env, params, timing)
    if config.peers != "none":
        result.peers.append(measure_jaxnav(config.sizes(), timing, _progress.print))
    return result


def run_many(config: ThroughputConfig, names: list[Any]) -> report.Result:
    """Measures in several tunnels at once, one drawn each episode; the LiDAR is compared in the first few of them.

    Raises:
        BenchmarkError: Something is asked for that takes one tunnel.
    """
    if config.peers == "jaxnav":
        raise BenchmarkError(f"--peers jaxnav takes one tunnel, and there are {len(names) * config.copies}")
    _progress.print(f"{len(names)} tunnels")
    made = tunnels.load(names, config.lining)
    env, params = st.make(config.task, tunnel=made * config.copies, sensor=config.sensor)
    lengths = np.broadcast_to(np.asarray(params.tunnel.length), (params.tunnel.count,))
    facts = {
        "name": config.tunnel or "packaged",
        "tunnels": params.tunnel.count,
        "length": float(lengths.mean()),
        "lining": config.lining or "the usual one of each",
    }
    result, timing = _begin(config, facts, params)
    if config.poses:
        some = names[:_COMPARED]
        _progress.print(f"exactness: {config.poses:,} poses in the first {len(some)}")
        whole = st.make(_WHOLE, tunnel=made[: len(some)])[1]
        result.exactness = measure_exactness_of_many(some, config.lining, whole, config.poses, config.seed)
    _measure_speeds(result, env, params, timing)
    return result


def _begin(config: ThroughputConfig, facts: dict[str, Any], params: Any) -> tuple[report.Result, Timing]:
    """Returns the results with nothing measured yet, and how it is timed."""
    n_beams = params.lidar.n_beams if hasattr(params, "lidar") else 0  # the B2 that walks has no LiDAR
    result = report.Result(config, environment_facts(), facts, n_beams)
    return result, Timing(config.steps, config.repeats, config.seconds, config.seed)


def _measure_speeds(result: report.Result, env: Any, params: Any, timing: Timing) -> None:
    """Measures each batch size."""
    for n_envs in result.config.sizes():
        _progress.print(f"subterra: {n_envs:,} environments")
        result.speeds.append(measure(environment_loop(env, params, n_envs), n_envs, timing))


def run_and_report(config: ThroughputConfig) -> int:
    """Measures, prints and writes; returns 1 where a number is not finite or a ray is wrong."""
    try:
        result = run(config)
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    # In a file or a pipe tables are not wrapped; a terminal knows its own width.
    report.show(result, Console(highlight=False, emoji=False, width=None if sys.stdout.isatty() else 120))
    if config.out is not None:
        write_file(config.out / "throughput.json", report.as_json(result).encode())
        write_records(config.out / "records.json", report.records_of(result))
    if result.exactness is not None and result.exactness.n_wrong:
        print("error: the LiDAR disagrees with the reference, so its speed counts for nothing", file=sys.stderr)
        return 1
    return 0


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 1 if the LiDAR is not exact, 2 for a user's mistake."""
    return run_main("throughput", ThroughputConfig, run_and_report, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
