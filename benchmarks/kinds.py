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
from subterra_jax.evaluation.floor import floor
from subterra_jax.evaluation.records import grouped, interval
from subterra_jax.host.files import require_folder
from subterra_jax.policies import open_agent
from subterra_jax.policies.files import read_facts
from subterra_jax.policies.locate.agent import Locating
from subterra_jax.policies.opening import policy_source
from subterra_jax.procedural.open_world import SPLITS, kinds_of
from subterra_jax.state import EnvParams
from subterra_jax.tasks import find
from subterra_jax.tunnel import Tunnel
from train.tunnels import load

SCHEMA = "subterra.kinds/1"
N_GROUPS = 10
CUT = "cut:"  # before the file of a learnt localiser: the ablation
NO_MAP = "nomap:"  # before one that takes a map: drive without
AGENTS = ("dead-reckoning", "fused", "ring-count", "ring-filter", "particle-filter", "oracle")
_OLD = "`subterra-351` and the older family"
TUNED_ON = {
    "dead-reckoning": "nothing",
    "fused": "nothing: told the sizes of the errors",
    "ring-count": _OLD,
    "ring-filter": _OLD,
    "particle-filter": f"{_OLD}; has the map, told the sizes of the errors",
    "histogram-filter": "nothing: has the map, told the sizes of the errors",
    "scan-matching": _OLD,
    "ceiling": "nothing: has the map, told the sizes of the errors and of each episode's faults",
    "oracle": "nothing: told the truth",
}
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class KindsConfig:
    """Settings of a table of kinds.

    Attributes:
        task: Task id.
        split: Split of the open world; a choice may be made on `val` alone.
        agents: Names of agents, or files of policies; `cut:FILE` is a learnt localiser without what walls tell it,
            `nomap:FILE` one that takes a map, without it.
        episodes: Episodes of each kind.
        tunnels: Tunnels of each kind, over which the episodes are spread; 0 leaves the kinds out.
        lining: `built`, `bare` or `smooth`.
        first: Index of the first tunnel.
        further: Names or files of further tunnels, a column each.
        batch: Episodes driven at the same time; 0 is all. Memory and speed alone depend on it.
        cache: Folder in which made tunnels are kept from run to run.
        out: Folder for `kinds.json` and `kinds.md`; `None` prints the table only.
    """

    task: str = "Subterra/StopAt-v1"
    split: str = "val"
    agents: tuple[str, ...] = AGENTS
    episodes: int = 100
    tunnels: int = 10
    lining: str = "built"
    first: int = 0
    further: tuple[str, ...] = ()
    batch: int = 0
    cache: Path | None = None
    out: Path | None = None


def run(config: KindsConfig) -> None:
    """Drives all agents and writes the table.

    Raises:
        SubterraError: A task, split, agent or lining is unknown, or the folder cannot be written.
    """
    check(config)
    kinds = kinds_of(config.split) if config.tunnels else ()
    names = [
        f"open:{kind}:{config.split}:{config.first + i}" for kind in kinds for i in range(config.tunnels)
    ]  # of one kind after another
    started = time.monotonic()
    task, tunnels = find(config.task, short=True), load(names, config.lining, config.cache)
    tunnels += [Tunnel.from_plan(plan, plan.default_lining) for plan in map(st.load_tunnel, config.further)]
    env, params = st.make(task, tunnel=tunnels if len(tunnels) > 1 else tunnels[0], estimates=True)
    _progress.print(f"{len(tunnels)} tunnels: {time.monotonic() - started:.0f} s")
    columns = (*kinds, *(Path(name).name for name in config.further))
    episodes = draw_episodes(config, len(kinds), len(config.further), "faults" in params.parts)
    lows = floors(params, config, len(columns))
    rows: dict[str, list] = {}
    for agent in config.agents:
        started = time.monotonic()
        records = evaluate(env, params, make_agent(agent, env, params), episodes, config.batch or len(episodes))
        rows[agent] = [summary(records, config, column) for column in range(len(columns))]
        _progress.print(f"{agent}: {100 * records.success.mean():.1f} % ({time.monotonic() - started:.0f} s)")
        if config.out is not None:  # after each agent, so that nothing is lost where one takes too long
            _write(config, columns, rows, lows)
    if config.out is None:
        print(as_markdown(config, columns, rows, lows))
    else:
        print(config.out / "kinds.md")


def _write(config: KindsConfig, columns: tuple[str, ...], rows: dict[str, list], lows: list[float] | None) -> None:
    """Writes the table of the agents so far."""
    assert config.out is not None
    content = {
        "schema": SCHEMA,
        "config": {name: str(value) if isinstance(value, Path) else value for name, value in vars(config).items()},
        "facts": {**environment_facts(), **constants_facts()},
        "floor": None if lows is None else dict(zip(columns, lows, strict=True)),
        "rows": {agent: dict(zip(columns, row, strict=True)) for agent, row in rows.items()},
        "policies": {agent: digest for agent in rows if (digest := _digest(agent)) is not None},
    }
    write_file(config.out / "kinds.json", (json.dumps(content, indent=1) + "\n").encode())
    write_file(config.out / "kinds.md", as_markdown(config, columns, rows, lows).encode())


def _digest(agent: str) -> str | None:
    """Returns the digest of a policy's tensors; None of a baseline."""
    source = policy_source(bare(agent))
    return None if source is None else read_facts(source)["tensors_sha256"]


def floors(params: EnvParams, config: KindsConfig, n_columns: int) -> list[float] | None:
    """Returns the most that anybody can have without a look at the walls by column, or None where it is not known."""
    if "slip" not in params.parts:
        return None
    if not hasattr(params, "told"):  # of version 0: starts at the mouth
        return [stop_bounds(params)["fused"]] * n_columns
    enough = float(np.max(params.goal.high)) + 2.0 * float(np.max(params.goal.margin))
    lengths = np.minimum(np.broadcast_to(np.asarray(params.tunnel.length), params.tunnel.count), enough)
    of_length = {length: floor(params, int(np.argmax(lengths == length))) for length in np.unique(lengths)}
    each = [of_length[length] for length in lengths]
    column = [column_of(index, config) for index in range(params.tunnel.count)]
    return [float(np.mean([low for low, one in zip(each, column, strict=True) if one == c])) for c in range(n_columns)]


def column_of(tunnel: Any, config: KindsConfig) -> Any:
    """Returns the column of a tunnel by its number: `config.tunnels` tunnels each of the kinds, then one each."""
    n_of_kinds = config.tunnels * len(kinds_of(config.split))
    by_kind = np.asarray(tunnel) // max(config.tunnels, 1)
    further = np.asarray(tunnel) - n_of_kinds + (len(kinds_of(config.split)) if config.tunnels else 0)
    return np.where(np.asarray(tunnel) < n_of_kinds, by_kind, further)


def make_agent(name: str, env: Any, params: EnvParams) -> Any:
    """Makes an agent by its name.

    Raises:
        BenchmarkError: What shall be cut is not a learnt localiser.
        SubterraError: There is no such agent or policy, or it does not fit the task.
    """
    agent = open_agent(bare(name), env, params)
    if name == bare(name):
        return agent
    if not isinstance(agent, Locating):
        raise BenchmarkError(f"{name}: only a learnt localiser can be cut, and this is {type(agent).__name__}")
    if name.startswith(CUT):
        return agent.without_walls()
    if not agent.takes_map:
        raise BenchmarkError(f"{name}: has no map to go without")
    return agent.without_map()


def bare(name: str) -> str:
    """Returns the name of an agent without the prefix that says what it is to do without."""
    return name.removeprefix(CUT).removeprefix(NO_MAP)


def check(config: KindsConfig) -> None:
    """Refuses settings that cannot be run, before anything is made.

    Raises:
        BenchmarkError: A split or an agent is unknown, or a number is too small.
    """
    require_least(config, episodes=1, tunnels=0 if config.further else 1, first=0, batch=0)
    if config.split not in SPLITS:
        raise BenchmarkError(f"there is no split {config.split!r}; there are {', '.join(SPLITS)}")
    for agent in config.agents:
        if agent not in registry.names() and policy_source(bare(agent)) is None:
            known = ", ".join(registry.names())
            raise BenchmarkError(f"no agent {agent!r}; there are {known}, or a policy's file or folder")
    if config.out is not None:
        require_folder(config.out)


def draw_episodes(config: KindsConfig, n_kinds: int, n_further: int = 0, faults: bool = False) -> Episodes:
    """Returns the same number of episodes for each column; their seeds depend on task and split alone.

    They lie below 2³⁰, where no listed episode is. With `faults` each severity comes equally often.
    """
    n = config.episodes
    generator = np.random.default_rng(zlib.crc32(f"{SCHEMA} {config.task} {config.split}".encode()))
    seeds = generator.choice(2**29, n, replace=False).astype(np.uint32) + np.uint32(2**29)
    index = np.arange(n)
    of_kinds = [kind * config.tunnels + index % config.tunnels for kind in range(n_kinds)]
    further = [n_kinds * config.tunnels + i + 0 * index for i in range(n_further)]
    severity = index // max(config.tunnels, 1) % 5 if faults else 0 * index
    n_columns = n_kinds + n_further
    return Episodes(
        seed=np.tile(seeds, n_columns),
        tunnel=np.concatenate([*of_kinds, *further]).astype(np.int32),
        severity=np.tile(severity, n_columns).astype(np.int32),
        group=np.tile(index * N_GROUPS // max(n, N_GROUPS), n_columns).astype(np.int32),
    )


def summary(records: Records, config: KindsConfig, column: int) -> dict[str, Any]:
    """Returns success with its 95 % interval, share of contacts and median error at the stop (m) of one column."""
    some = records.where(column_of(records.tunnel, config) == column)
    low, high = interval(grouped(some.success.astype(float), some.group), lambda s: s.mean(axis=(-2, -1)))
    stopped = np.abs(some.goal_error[~np.isnan(some.goal_error) & ~some.contact])
    return {
        "success": float(some.success.mean()),
        "low": low,
        "high": high,
        "contact": float(some.contact.mean()),
        "median_error": float(np.median(stopped)) if len(stopped) else None,
        "by_tunnel": [float(some.success[some.tunnel == t].mean()) for t in np.unique(some.tunnel)],
        "episodes": some.success.astype(int).tolist(),
    }


def as_markdown(config: KindsConfig, kinds: tuple[str, ...], rows: dict[str, list], lows: list[float] | None) -> str:
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
    if lows is not None:
        shares = " | ".join(f"{100 * low:.0f}" for low in lows)
        lines.insert(4, f"| floor: most without a look at the walls | | {shares} |")
    return "\n".join(lines) + "\n"


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("kinds", KindsConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
