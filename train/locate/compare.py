"""Trains several networks in turns, each for the same time of the device: `python -m train.locate.compare --out DIR`.

All learn in the same tunnels, with the same seed from the same drives, and are scored on the same drives in `val`.
They are compiled side by side at first, which counts for none of them.
"""

import concurrent.futures
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file
from train import tunnels
from train.config import ConfigError
from train.locate import scores
from train.locate.command import Command as Training
from train.locate.command import check
from train.locate.keeping import CURVE, LOG, check_folder
from train.locate.learner import LocateConfig
from train.locate.session import VAL_SEED, Session, begin, finish

_FIRST = 2  # iterations that tell no rate


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains several networks in turns.

    Attributes:
        out: Folder with a run of `train.locate` for each network, and the table `compare.md`.
        networks: Names of networks.
        task: Task that is driven.
        tunnels: Tunnels to learn in.
        val: Tunnels to score in.
        drives: Drives of the score.
        seed: Seed of weights and drives.
        cache: Folder in which made tunnels are kept from run to run.
        score_every: Time between two scores of a network, s.
        limit: Time after which all shall end, with tunnels and compiling, s; each network gets its part of it at most.
        config: Settings of all; `minutes` is the time of each.
    """

    out: Path
    networks: tuple[str, ...] = ("gru", "s5", "transformer", "kalman")
    task: str = Training.task
    tunnels: str = Training.tunnels
    val: str = Training.val
    drives: int = Training.drives
    seed: int = 0
    cache: Path | None = None
    score_every: float = 10.0
    limit: float = 3600.0
    config: tyro.conf.OmitArgPrefixes[LocateConfig] = dataclasses.field(
        default_factory=lambda: LocateConfig(minutes=1.5)
    )


def run(arguments: Command) -> None:
    """Trains, scores, and writes the table.

    Raises:
        ConfigError: A setting is wrong.
        SubterraError: There is no such task or tunnel, or a folder cannot be written.
    """
    started = time.monotonic()
    if not arguments.networks or len(set(arguments.networks)) != len(arguments.networks):
        raise ConfigError(f"networks must differ, got {' '.join(arguments.networks) or 'none'}")
    runs = {network: training(arguments, network) for network in arguments.networks}
    for one in runs.values():
        check(one)
        check_folder(one)
    names, val = tunnels.names_of(arguments.tunnels), tunnels.names_of(arguments.val)
    made = tunnels.load(names + val, None, arguments.cache)
    env, params = tunnels.enter(arguments.task, made[: len(names)])
    drives = scores.record(
        *tunnels.enter(arguments.task, made[len(names) :]),
        jax.random.key(VAL_SEED),
        arguments.drives,
        speed=arguments.config.speed,
    )
    sessions = {network: Session(one, env, params, drives) for network, one in runs.items()}
    print(f"{len(made)} tunnels: {time.monotonic() - started:.0f} s", flush=True)
    with concurrent.futures.ThreadPoolExecutor(len(sessions)) as pool:
        list(pool.map(Session.compile, sessions.values()))
    print(f"compiled: {time.monotonic() - started:.0f} s", flush=True)
    for network, session in sessions.items():
        begin(session, runs[network])
    room = max(arguments.limit - (time.monotonic() - started), 1.0) / len(sessions)
    budget, left = min(60.0 * arguments.config.minutes, room), dict(sessions)
    for session in sessions.values():
        session.open(budget)
    while left:
        network = min(left, key=lambda name: left[name].spent)
        left[network].turn()
        if left[network].spent >= budget:
            del left[network]
    for network, session in sessions.items():
        session.close()
        finish(session, runs[network], drives)
    table = as_markdown({network: read(one.out / f"seed-{arguments.seed}") for network, one in runs.items()})
    with replace_file(arguments.out / "compare.md") as fresh:
        fresh.write_text(table)
    print(table)


def training(arguments: Command, network: str) -> Training:
    """Returns the training of one network."""
    common = ("task", "tunnels", "val", "drives", "cache", "score_every")
    return Training(
        out=arguments.out / network,
        seeds=(arguments.seed,),
        config=dataclasses.replace(arguments.config, network=network),
        **{name: getattr(arguments, name) for name in common},
    )


def read(folder: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Returns log and curve of a run."""
    log, curve = ([json.loads(line) for line in (folder / name).read_text().splitlines()] for name in (LOG, CURVE))
    return log, curve


def as_markdown(found: dict[str, tuple[list[dict[str, Any]], list[dict[str, Any]]]]) -> str:
    """Returns the table: steps/s, updates, and of `val` the share of right estimates as time goes on."""
    head = "| network | steps/s | time, s | updates | right to 1 m, % of goals in `val` (after s) |"
    lines = [head, "|---|---|---|---|---|"]
    for network, (log, curve) in found.items():
        rates = [row["rate"] for row in log[_FIRST:]] or [row["rate"] for row in log]
        some = [curve[i] for i in sorted({*range(0, len(curve), max(1, len(curve) // 5)), len(curve) - 1})]
        shares = ", ".join(f"{100 * row['within']:.1f} ({row['seconds']:.0f})" for row in some)
        last = curve[-1]
        rate = f"{np.median(rates):,.0f}"
        lines.append(f"| {network} | {rate} | {last['seconds']:.0f} | {last['updates']} | {shares} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Runs `python -m train.locate.compare`."""
    sys.exit(run_command(lambda: run(parse(_read))))


def _read(words: list[str]) -> Command:
    plain = (tyro.conf.FlagCreatePairsOff,)
    return tyro.cli(Command, args=words, prog="python -m train.locate.compare", description=__doc__, config=plain)


if __name__ == "__main__":
    main()
