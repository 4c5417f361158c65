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
from benchmarks.reference import measure_exactness
from benchmarks.results import environment_facts
from benchmarks.throughput import report
from benchmarks.throughput.config import ThroughputConfig, check
from benchmarks.throughput.loops import environment_loop, measure_jaxnav, require_jaxnav
from benchmarks.throughput.timing import Timing, measure
from subterra_jax.host.files import require_folder
from subterra_jax.tasks import first_tunnel
from train import tunnels

_WHOLE = "Subterra/Traverse-v1"  # whose stretch is the whole tunnel
_COMPARED = 8  # tunnels of several in which the LiDAR is compared
_progress = Console(stderr=True, highlight=False, emoji=False)


def run(config: ThroughputConfig) -> report.Result:
    """Measures everything that the settings ask for: in one tunnel, beside JaxNav, or in several, one an episode.

    Raises:
        SubterraError: A tunnel, lining or peer is missing, or a setting is out of range.
        ValueError: No such task.
        FloatingPointError: An observation or a reward is not finite.
    """
    check(config)
    if config.out is not None:
        require_folder(config.out)
    names: list[Any] = [first_tunnel(config.task)] if config.tunnel is None else tunnels.names_of(config.tunnel)
    count = len(names) * config.copies
    if config.peers == "jaxnav":
        if count > 1:
            raise BenchmarkError(f"--peers jaxnav takes one tunnel, and there are {count}")
        require_jaxnav()
    plans = [st.load_tunnel(name) for name in names[:_COMPARED]]
    made: Any = tunnels.load(names, config.lining, config.sensor) if count > 1 else plans[0]
    lining = config.lining if count == 1 else None  # what is made already has its lining
    shown: Any = {} if config.texture is None else {"intensity": True, "texture": config.texture}
    copies = made * config.copies if count > 1 else made
    env, params = st.make(config.task, copies, lining, sensor=config.sensor, **shown)
    facts = {
        "name": plans[0].name if count == 1 else config.tunnel,
        "tunnels": count,
        "length": float(np.mean(np.asarray(params.tunnel.length))),
        "lining": config.lining or ("the usual one of each" if count > 1 else plans[0].default_lining),
    }
    n_beams = params.lidar.n_beams if hasattr(params, "lidar") else 0  # the B2 that walks has no LiDAR
    result = report.Result(config, environment_facts(), facts, n_beams)
    if config.poses:
        _progress.print(f"exactness: {config.poses:,} poses in {len(plans)}")
        # The comparison with the reference uses the whole tunnel, whichever stretch the task uses.
        whole = st.make(_WHOLE, made[: len(plans)] if count > 1 else made, lining)[1]
        result.exactness = measure_exactness(plans, config.lining, whole, config.poses, config.seed)
    timing = Timing(config.steps, config.repeats, config.seconds, config.seed)
    for n_envs in config.sizes():
        _progress.print(f"subterra: {n_envs:,} environments")
        result.speeds.append(measure(environment_loop(env, params, n_envs), n_envs, timing))
    if config.peers != "none" and count == 1:
        result.peers.append(measure_jaxnav(config.sizes(), timing, _progress.print))
    return result


def run_and_report(config: ThroughputConfig) -> int:
    """Measures, prints and writes; returns 1 where a number is not finite or a ray is wrong."""
    try:
        result = run(config)
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(report.as_text(result))
    if config.out is not None:
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
