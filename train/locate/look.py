"""Scores localisers on recorded drives, by kind: `python -m train.locate.look POLICY [POLICY ...] --out DIR`.

All policies, and each with what walls tell cut out, see the same drives; one that takes a map also with the map, with a
hidden start (with the map and without), and with a map of another place. A drive counts for every goal 60 to 320 m from
its start: the score is the success of stops at goals drawn from these, but for the last step of 0.2 m.
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

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file
from subterra_jax.policies import check_fits
from subterra_jax.policies.files import read_facts
from subterra_jax.policies.locate import memory, streams
from subterra_jax.policies.locate.agent import Locating, nested
from subterra_jax.policies.locate.map_strip import map_strip
from train import tunnels
from train.config import at_least
from train.locate import scores
from train.locate.drives import Drive

SCHEMA = "subterra.look/1"
_KINDS = ("straight", "universal", "cast", "sprayed", "masonry", "rock")
_SEED = 2**22
_RESAMPLES = 2000


@dataclasses.dataclass(frozen=True)
class Command:
    """Scores localisers on recorded drives.

    Attributes:
        policies: Localisers of `train.locate`.
        out: Folder for `look.json` and `look.md`.
        task: Task that is driven.
        sensor: The LiDAR, by name.
        tunnels: Tunnels; a choice may be made on `val` alone.
        drives: Drives, spread over the tunnels; localisers of one speed see the same.
        seed: Added to the seed of the drives.
        cache: Folder in which made tunnels are kept from run to run.
    """

    policies: tyro.conf.Positional[tuple[str, ...]]
    out: Path
    task: str = "Subterra/StopAt-v1"
    sensor: str = tunnels.PLANAR
    tunnels: str = ",".join(f"open:{kind}:test-unseen:0-9" for kind in _KINDS)
    drives: int = 300
    seed: int = 0
    cache: Path | None = None


def command(arguments: Command) -> None:
    """Records, scores and writes.

    Raises:
        ConfigError: A policy is no localiser, or a number out of range.
        SubterraError: There is no such policy, task or tunnel, or a policy does not fit the sensor.
    """
    at_least(arguments, 1, "drives")
    at_least(arguments, 0, "seed")
    agents = {name: scores.open_localiser(name) for name in arguments.policies}
    names = tunnels.names_of(arguments.tunnels)
    found = tunnels.load(names, None, arguments.cache, arguments.sensor)
    env, params = tunnels.enter(arguments.task, found, arguments.sensor)
    for name, agent in agents.items():
        check_fits(agent, env, params, name)
    key = jax.random.key(_SEED + arguments.seed)
    speeds = {agent.speed for agent in agents.values()}
    recorded = {speed: scores.record(env, params, key, arguments.drives, speed=speed) for speed in speeds}
    print(f"{arguments.drives} drives", flush=True)
    rows: dict[str, Any] = {}
    names_of: dict[str, str] = {}
    for name, agent in agents.items():
        drives = recorded[agent.speed]
        tunnel = np.asarray(drives.tunnel)
        kinds = np.array([scores.kind_of(one) for one in names])[tunnel.astype(int)]
        for blind in (False, True):
            label = f"cut:{name}" if blind else name
            rows[label], names_of[label] = table(within(agent, drives, blind), tunnel, kinds), name
        if agent.takes_map:
            judge = scores.make_judge(agent.network)
            shares = judge(nested(agent.tensors), drives, map_strip(params.tunnel))
            for case in scores.WITH_MAP:
                label = f"{case}:{name}"
                rows[label], names_of[label] = table(np.asarray(shares[case]), tunnel, kinds), name
        for label in rows:
            if names_of[label] == name:
                print(label, {kind: round(100 * cell["success"]) for kind, cell in rows[label].items()}, flush=True)
        _write(arguments, rows, names_of)
    print(arguments.out / "look.md")


def within(agent: Locating, drives: Drive, blind: bool) -> np.ndarray:
    """Returns the share of the goals of each drive at which the estimate is right to 1 m; NaN without a goal."""
    weights, n = nested(agent.tensors), scores.FARTHEST
    goals = jnp.arange(n) >= scores.FIRST - 1

    def one(drive: Drive) -> Any:
        blocks = streams.metres(drive.record, weights.get("match"), n)
        if blind:
            blank = {name: jnp.zeros_like(getattr(blocks, name)) for name in ("evidence", "raw")}
            blocks = dataclasses.replace(blocks, **blank)
        answers = memory.sequence(agent.network, weights, blocks)
        ends = jnp.arange(1.0, n + 1.0)
        error = answers.correction - jnp.interp(ends, drive.record.driven, drive.moved) + ends
        use = goals & streams.reached(drive.record, n)
        return jnp.sum(use & (jnp.abs(error) <= 1.0)) / jnp.sum(use)

    return np.asarray(jax.jit(lambda drives: jax.lax.map(one, drives, batch_size=16))(drives))


def table(share: np.ndarray, tunnel: np.ndarray, kinds: np.ndarray) -> dict[str, dict[str, float]]:
    """Returns the mean by kind, and over the kinds as `all`, with 95 % intervals over drawn tunnels and drives."""
    rng, found, draws = np.random.default_rng(0), {}, []
    for kind in dict.fromkeys(kinds.tolist()):
        rows = (kinds == kind) & ~np.isnan(share)
        groups = [share[rows & (tunnel == one)] for one in np.unique(tunnel[rows])]
        drawn = [
            np.concatenate([rng.choice(groups[i], len(groups[i])) for i in rng.integers(len(groups), size=len(groups))])
            for _ in range(_RESAMPLES)
        ]
        draws.append(np.array([one.mean() for one in drawn]))
        low, high = np.quantile(draws[-1], (0.025, 0.975))
        found[kind] = {
            "success": float(share[rows].mean()),
            "low": float(low),
            "high": float(high),
            "n": int(rows.sum()),
        }
    low, high = np.quantile(np.mean(draws, axis=0), (0.025, 0.975))
    mean = float(np.mean([cell["success"] for cell in found.values()]))
    return {**found, "all": {"success": mean, "low": float(low), "high": float(high), "n": len(share)}}


def _write(arguments: Command, rows: dict[str, Any], names_of: dict[str, str]) -> None:
    arguments.out.mkdir(parents=True, exist_ok=True)
    columns = list(next(iter(rows.values())))
    lines = ["| localiser | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for label, row in rows.items():
        cells = [f"{100 * c['success']:.0f} ({100 * c['low']:.0f} to {100 * c['high']:.0f})" for c in row.values()]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    names = ("task", "sensor", "tunnels", "drives", "seed")
    facts = {
        "schema": SCHEMA,
        "config": {name: getattr(arguments, name) for name in names},
        "policies": {label: read_facts(names_of[label])["tensors_sha256"] for label in rows},
        "rows": rows,
    }
    for name, text in (("look.md", "\n".join(lines)), ("look.json", json.dumps(facts, indent=1))):
        with replace_file(arguments.out / name) as fresh:
            fresh.write_text(f"{text}\n")


def main() -> None:
    """Runs `python -m train.locate.look`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.locate.look", description=__doc__)


if __name__ == "__main__":
    main()
