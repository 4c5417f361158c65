"""The speeds and the exactness of a measurement as records."""

from benchmarks.records import Record, measured
from benchmarks.throughput.report import Result


def records_of(result: Result) -> list[Record]:
    """Return the records of a measurement: `speed/cpu-N` or `speed/step-N` in one tunnel, `speed/K-tunnels` in many."""
    config, many = result.config, result.tunnel.get("tunnels")
    command = f"benchmarks.throughput {_words(result)}--out out/speed"
    where = f"{config.task.removeprefix('Subterra/')}, {result.tunnel['name']}"
    found = []
    if result.exactness is not None and not many:
        error, rays = 1e3 * result.exactness.max_error, result.exactness.n_rays
        found.append(
            measured("speed/lidar-error", round(error, 2), "mm", command, split=where, n=rays, bound="at most")
        )
    for speed in result.speeds:
        one = f"{'cpu' if result.environment['platform'] == 'cpu' else 'step'}-{speed.n_envs}"
        name = one if not many else f"{many}-tunnels" + ("" if speed.n_envs == 65_536 else f"-{speed.n_envs}")
        rate = round(1e-6 * speed.quartiles[1], 3)
        found.append(measured(f"speed/{name}", rate, "M steps/s", command, split=where, bound="at least"))
    return found


def _words(result: Result) -> str:
    """Return the options that a measurement again needs."""
    config = result.config
    tunnel = f"--tunnel {config.tunnel} --copies {config.copies} " if config.tunnel else ""
    return f"--task {config.task} {tunnel}--n {' '.join(map(str, config.sizes()))} --poses {config.poses} --peers none "
