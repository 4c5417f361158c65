"""Agents on the kinds of lining of the open world: success by kind, with intervals, and what each was tuned on.

`python -m benchmarks.kinds --episodes 100 --tunnels 10 --out out/kinds`
"""

import dataclasses
import json
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import subterra_jax as st
from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.results import constants_facts, environment_facts, write_file
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes, Records, evaluate
from subterra_jax.evaluation.bounds import stop_bounds
from subterra_jax.evaluation.records import grouped, interval
from subterra_jax.host.files import require_folder
from subterra_jax.policies import open_agent
from subterra_jax.policies.locate.agent import Locating
from subterra_jax.policies.opening import policy_source
from subterra_jax.procedural.open_world import SPLITS, kinds_of
from subterra_jax.state import EnvParams
from subterra_jax.tasks import find
from train.locate.tunnels import load

SCHEMA = "subterra.kinds/1"
N_GROUPS = 10
CUT = "cut:"  # before the file of a learnt localiser: the ablation
AGENTS = ("dead-reckoning", "fused", "ring-count", "ring-filter", "particle-filter", "oracle")
_OLD = "`subterra-351` and the older family"
TUNED_ON = {
    "dead-reckoning": "nothing",
    "fused": "nothing: told the sizes of the errors",
    "ring-count": _OLD,
    "ring-filter": _OLD,
    "particle-filter": f"{_OLD}; has the map, told the sizes of the errors",
    "scan-matching": _OLD,
    "oracle": "nothing: told the truth",
}
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class KindsConfig:
    """Settings of a table of kinds.

    Attributes:
        task: Task id.
        split: Split of the open world; a choice may be made on `val` alone.
        agents: Names of agents, or files of policies; `cut:FILE` is a learnt localiser without what walls tell it.
        episodes: Episodes of each kind.
        tunnels: Tunnels of each kind, over which the episodes are spread.
        lining: `built`, `bare` or `smooth`.
        first: Index of the first tunnel.
        cache: Folder in which made tunnels are kept from run to run.
        out: Folder for `kinds.json` and `kinds.md`; `None` prints the table only.
    """

    task: str = "Subterra/StopAt-v0"
    split: str = "val"
    agents: tuple[str, ...] = AGENTS
    episodes: int = 100
    tunnels: int = 10
    lining: str = "built"
    first: int = 0
    cache: Path | None = None
    out: Path | None = None


def run(config: KindsConfig) -> None:
    """Drives all agents and writes the table.

    Raises:
        SubterraError: A task, split, agent or lining is unknown, or the folder cannot be written.
    """
    check(config)
    kinds = kinds_of(config.split)
    names = [
        f"open:{kind}:{config.split}:{config.first + i}" for kind in kinds for i in range(config.tunnels)
    ]  # of one kind after another
    started = time.monotonic()
    task, tunnels = find(config.task, short=True), load(names, config.lining, config.cache)
    env, params = st.make(task, tunnel=tunnels if len(tunnels) > 1 else tunnels[0], estimates=True)
    _progress.print(f"{len(names)} tunnels: {time.monotonic() - started:.0f} s")
    episodes = draw_episodes(config, len(kinds))
    found = {}
    for agent in config.agents:
        started = time.monotonic()
        found[agent] = evaluate(env, params, _agent(agent, env, params), episodes, len(episodes))
        _progress.print(f"{agent}: {100 * found[agent].success.mean():.1f} % ({time.monotonic() - started:.0f} s)")
    rows = {agent: [summary(records, config, kind) for kind in range(len(kinds))] for agent, records in found.items()}
    text = as_markdown(config, kinds, rows, params)
    if config.out is None:
        print(text)
        return
    content = {
        "schema": SCHEMA,
        "config": {name: str(value) if isinstance(value, Path) else value for name, value in vars(config).items()},
        "facts": {**environment_facts(), **constants_facts()},
        "floor": stop_bounds(params) if "slip" in params.parts else None,
        "rows": {agent: dict(zip(kinds, row, strict=True)) for agent, row in rows.items()},
    }
    write_file(config.out / "kinds.json", (json.dumps(content, indent=1) + "\n").encode())
    write_file(config.out / "kinds.md", text.encode())
    print(config.out / "kinds.md")


def _agent(name: str, env: Any, params: EnvParams) -> Any:
    """Makes an agent by its name.

    Raises:
        BenchmarkError: What shall be cut is not a learnt localiser.
        SubterraError: There is no such agent or policy, or it does not fit the task.
    """
    agent = open_agent(name.removeprefix(CUT), env, params)
    if not name.startswith(CUT):
        return agent
    if not isinstance(agent, Locating):
        raise BenchmarkError(f"{name}: only a learnt localiser can be cut, and this is {type(agent).__name__}")
    return agent.without_walls()


def check(config: KindsConfig) -> None:
    """Refuses settings that cannot be run, before anything is made.

    Raises:
        BenchmarkError: A split or an agent is unknown, or a number is too small.
    """
    require_least(config, episodes=1, tunnels=1, first=0)
    if config.split not in SPLITS:
        raise BenchmarkError(f"there is no split {config.split!r}; there are {', '.join(SPLITS)}")
    for agent in config.agents:
        if agent not in registry.names() and policy_source(agent.removeprefix(CUT)) is None:
            known = ", ".join(registry.names())
            raise BenchmarkError(f"no agent {agent!r}; there are {known}, or a policy's file or folder")
    if config.out is not None:
        require_folder(config.out)


def draw_episodes(config: KindsConfig, n_kinds: int) -> Episodes:
    """Returns the same number of episodes for each kind; their seeds depend on task and split alone.

    They lie below 2³⁰, where no listed episode is.
    """
    n = config.episodes
    generator = np.random.default_rng(zlib.crc32(f"{SCHEMA} {config.task} {config.split}".encode()))
    seeds = generator.choice(2**29, n, replace=False).astype(np.uint32) + np.uint32(2**29)
    index = np.arange(n)
    return Episodes(
        seed=np.tile(seeds, n_kinds),
        tunnel=np.concatenate([kind * config.tunnels + index % config.tunnels for kind in range(n_kinds)]).astype(
            np.int32
        ),
        severity=np.zeros(n * n_kinds, np.int32),
        group=np.tile(index * N_GROUPS // max(n, N_GROUPS), n_kinds).astype(np.int32),
    )


def summary(records: Records, config: KindsConfig, kind: int) -> dict[str, Any]:
    """Returns success with its 95 % interval, share of contacts and median error at the stop (m) of one kind."""
    some = records.where(records.tunnel // config.tunnels == kind)
    low, high = interval(grouped(some.success.astype(float), some.group), lambda s: s.mean(axis=(-2, -1)))
    stopped = np.abs(some.goal_error[~np.isnan(some.goal_error) & ~some.contact])
    return {
        "success": float(some.success.mean()),
        "low": low,
        "high": high,
        "contact": float(some.contact.mean()),
        "median_error": float(np.median(stopped)) if len(stopped) else None,
        "by_tunnel": [float(some.success[some.tunnel == t].mean()) for t in np.unique(some.tunnel)],
    }


def as_markdown(config: KindsConfig, kinds: tuple[str, ...], rows: dict[str, list], params: EnvParams) -> str:
    """Returns the table: success in % with its interval, then the median error at the stop in m."""
    lines = [
        f"`{config.task}`, split `{config.split}`, lining `{config.lining}`: {config.tunnels} tunnels and "
        f"{config.episodes} episodes of each kind. Success in %, its 95 % interval, median error at the stop in m.",
        "",
        "| agent | tuned on | " + " | ".join(kinds) + " |",
        "|---|---|" + "---|" * len(kinds),
    ]
    for agent, row in rows.items():
        cells = [
            f"{100 * one['success']:.0f} ({100 * one['low']:.0f} to {100 * one['high']:.0f}), "
            + ("-" if one["median_error"] is None else f"{one['median_error']:.2f}")
            + (f", contact {100 * one['contact']:.0f}" if one["contact"] else "")
            for one in row
        ]
        lines.append(f"| {agent} | {TUNED_ON.get(agent, 'not known')} | " + " | ".join(cells) + " |")
    if "slip" in params.parts:
        floor = 100 * stop_bounds(params)["fused"]
        lines += ["", f"The most that anybody can have without a look at the walls: {floor:.0f} %."]
    return "\n".join(lines) + "\n"


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("kinds", KindsConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
