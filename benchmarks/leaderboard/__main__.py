"""Every agent on every task, on the fixed list of episodes, with intervals.

`python -m benchmarks.leaderboard --tasks StopAt Return --agents dead-reckoning oracle --out out/leaderboard`
"""

import sys
import time

import tyro
from rich.console import Console

from benchmarks.command import status
from benchmarks.leaderboard import figure, report
from benchmarks.leaderboard.board import scores, totals
from benchmarks.leaderboard.config import LeaderboardConfig, agents_for, checked, worlds
from benchmarks.leaderboard.entries import entry_of, write
from benchmarks.throughput.facts import environment_facts
from scene.arguments import parse

_progress = Console(stderr=True, highlight=False)


def run(config: LeaderboardConfig) -> None:
    """Drives what has not been driven yet, and writes the leaderboard.

    Raises:
        SubterraError: Something that was asked for is not there, or the folder cannot be written.
        ValueError: A tunnel in which a task has no room.
    """
    config = checked(config)
    asked = [
        (task, world, agent) for world in worlds(config) for task in config.tasks for agent in agents_for(config, task)
    ]
    entries = []
    for number, (task, world, agent) in enumerate(asked, 1):
        began = time.monotonic()
        entry, read = entry_of(config.out / "entries", task, world, agent, config.episodes, config.batch)
        entries.append(entry)
        took = "read" if read else f"{time.monotonic() - began:.0f} s"
        success = 100.0 * entry.records.success.mean()
        _progress.print(f"{number}/{len(asked)} {task}, {world.title}, {agent}: {success:.1f} % ({took})")
    facts = {**environment_facts(), "episodes": config.episodes}
    rows, overall = scores(entries), totals(entries)
    write(config.out / "leaderboard.json", report.as_json(rows, overall, facts).encode())
    write(config.out / "leaderboard.md", report.as_markdown(rows, overall, facts).encode())
    write(config.out / "leaderboard.png", figure.as_png(rows, facts))
    print(config.out / "leaderboard.md")


def main() -> int:
    """Entry point; the status is 2 for a user's mistake and 130 for an interrupt, after which a run can go on."""
    config = parse(
        lambda words: tyro.cli(
            LeaderboardConfig, args=words, prog="python -m benchmarks.leaderboard", description=__doc__
        )
    )
    return status(lambda: run(config), "interrupted; the same command goes on")


if __name__ == "__main__":
    sys.exit(main())
