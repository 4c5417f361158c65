"""Weighs a localiser against commands and odometry fused, by what both claim: `python -m train.locate.weigh POLICY`.

Both see the same recorded drives of `val`. A rule takes the fused estimate where the localiser claims a larger error
than `k` times the fused one's, or the mean of both, weighted by their claims. `k` is to be chosen here, on `val`.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.fused import FusedCount
from subterra_jax.baselines.stations import Driven
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file
from subterra_jax.policies import check_fits
from subterra_jax.policies.locate.agent import nested
from train import tunnels
from train.config import at_least
from train.locate import scores
from train.locate.drives import Drive
from train.locate.learner import estimate

_KINDS = ("straight", "cast", "sprayed", "masonry")
_SEED = 2**23
_TO_SIGMA = 1.2533
RATIOS = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5)
_RESAMPLES = 2000


@dataclasses.dataclass(frozen=True)
class Command:
    """Weighs a localiser against commands and odometry fused.

    Attributes:
        policy: A localiser of `train.locate`.
        out: File of the table, `.json`; None only prints it.
        task: Task that is driven.
        sensor: The LiDAR, by name.
        val: Tunnels; of `val`, since a rule is chosen.
        drives: Drives, spread over the tunnels.
        cache: Folder in which made tunnels are kept from run to run.
    """

    policy: tyro.conf.Positional[str]
    out: Path | None = None
    task: str = "Subterra/StopAt-v1"
    sensor: str = tunnels.PLANAR
    val: str = ",".join(f"open:{kind}:val:0-9" for kind in _KINDS)
    drives: int = 320
    cache: Path | None = None


def command(arguments: Command) -> None:
    """Records, weighs and prints.

    Raises:
        ConfigError: The policy is no localiser, or a number out of range.
        SubterraError: There is no such policy, task or tunnel, or the policy does not fit the sensor.
    """
    at_least(arguments, 1, "drives")
    agent = scores.open_localiser(arguments.policy)
    names = tunnels.names_of(arguments.val)
    env, params = tunnels.enter(
        arguments.task, tunnels.load(names, None, arguments.cache, arguments.sensor), arguments.sensor
    )
    check_fits(agent, env, params, arguments.policy)
    drives = scores.record(env, params, jax.random.key(_SEED), arguments.drives, speed=agent.speed)
    weights = nested(agent.tensors)
    found = jax.jit(lambda d: jax.lax.map(lambda one: both(agent.network, weights, one, params), d, batch_size=16))
    rows = weigh(jax.device_get(found(drives)))
    kinds = np.array([scores.kind_of(name) for name in names])[np.asarray(drives.tunnel).astype(int)]
    table = {rule: by_kind(share, kinds) for rule, share in rows.items()}
    gain = {rule: difference(share - rows["localiser"], np.asarray(drives.tunnel)) for rule, share in rows.items()}
    for rule, row in table.items():
        cells = " ".join(f"{kind} {100 * value:.1f}" for kind, value in row.items())
        low, high = gain[rule]
        print(f"{rule:28s} {cells}; less the localiser alone {100 * low:+.1f} to {100 * high:+.1f}", flush=True)
    if arguments.out is not None:
        facts = {"command": {"policy": arguments.policy, "val": arguments.val, "drives": arguments.drives}}
        with replace_file(arguments.out) as fresh:
            fresh.write_text(json.dumps({**facts, "rows": table, "gain": gain}, indent=1) + "\n")


def both(network: str, weights: Any, drive: Drive, params: Any) -> dict[str, Array]:
    """Returns errors (m) and claimed standard deviations (m) of both after each metre of a drive, and its goals."""
    n = scores.FARTHEST
    answers, truth, valid = estimate(network, weights, drive, n)
    commanded, sigma = fuse(drive, params)
    ends = jnp.arange(1.0, n + 1.0)
    at_end = lambda values: jnp.interp(ends, drive.record.driven, values)  # noqa: E731
    return {
        "localiser": answers.correction - truth,
        "claimed": _TO_SIGMA * jnp.exp(answers.log_scale),
        "fused": at_end(commanded) - ends - truth,
        "fused_claimed": at_end(sigma),
        "use": valid & (ends >= scores.FIRST),
    }


def fuse(drive: Drive, params: Any) -> tuple[Float[Array, "time"], Float[Array, "time"]]:
    """Returns the fused distance since the start at each step of a drive, and its standard deviation, m."""
    period, one, no = params.vehicle.period, jnp.ones(()), jnp.zeros((), bool)
    blank = Observed(jnp.zeros(1), jnp.zeros(1), distance=jnp.zeros(()), heading=jnp.zeros(()), start=jnp.zeros(()))

    def step(memory: Any, row: tuple[Array, Array]) -> tuple[Any, tuple[Array, Array]]:
        moved, read = row
        driven = Driven(moved / period, one, one, no)
        station, after = FusedCount().update(memory, dataclasses.replace(blank, distance=read), driven, params, None)
        return after, (station.station, jnp.exp(station.log_sigma))

    record = drive.record
    begun = FusedCount().begin(dataclasses.replace(blank, distance=record.read[0]), params)
    return jax.lax.scan(step, begun, (jnp.diff(record.driven, prepend=record.driven[:1]), record.read))[1]


def weigh(found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the share of goals at which each rule is right to 1 m, by drive; NaN without a goal."""
    mine, other = found["localiser"], found["fused"]
    claimed, fused = found["claimed"], found["fused_claimed"]
    errors = {"localiser": mine, "fused": other}
    for k in RATIOS:
        errors[f"fused where above {k:g}"] = np.where(claimed > k * fused, other, mine)
        share = claimed**2 / (claimed**2 + (k * fused) ** 2)
        errors[f"mean, fused times {k:g}"] = (1.0 - share) * mine + share * other
    use = found["use"]
    count = np.where(use.any(axis=1), use.sum(axis=1), np.nan)
    return {rule: (use & (np.abs(error) <= 1.0)).sum(axis=1) / count for rule, error in errors.items()}


def by_kind(share: np.ndarray, kinds: np.ndarray) -> dict[str, float]:
    """Returns the mean by kind, and over the kinds as `all`."""
    table = {kind: float(np.nanmean(share[kinds == kind])) for kind in dict.fromkeys(kinds.tolist())}
    return {**table, "all": float(np.mean(list(table.values())))}


def difference(gain: np.ndarray, tunnel: np.ndarray) -> tuple[float, float]:
    """Returns the 95 % interval of a mean difference between two rules on the same drives, over drawn tunnels."""
    groups = [gain[(tunnel == one) & ~np.isnan(gain)] for one in np.unique(tunnel)]
    groups = [group for group in groups if len(group)]
    rng = np.random.default_rng(0)
    drawn = [
        np.concatenate([groups[i] for i in rng.integers(len(groups), size=len(groups))]).mean()
        for _ in range(_RESAMPLES)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high)


def main() -> None:
    """Runs `python -m train.locate.weigh`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.locate.weigh", description=__doc__)


if __name__ == "__main__":
    main()
