"""Every agent on every task, on the fixed list of episodes, with intervals.

`python -m benchmarks.leaderboard --tasks StopAt Return --agents dead-reckoning oracle --out out/leaderboard`
"""

import sys
import time

from rich.console import Console

from benchmarks.command import run_main
from benchmarks.leaderboard import report
from benchmarks.leaderboard.entries import LeaderboardConfig, agents_for, check, load_worlds, make_entry
from benchmarks.results import constants_facts, environment_facts, write_file

_progress = Console(stderr=True, highlight=False)


def run(config: LeaderboardConfig) -> None:
    """Evaluates missing entries and writes the leaderboard; or draws the figure of a written one again.

    Raises:
        SubterraError: A task, agent, tunnel or file is missing or wrong, or the folder cannot be written.
        ValueError: A task does not fit into a tunnel.
    """
    if config.redraw is not None:
        rows, facts = report.read_markdown(config.redraw)
        write_file(config.redraw.with_suffix(".png"), report.as_png(rows, facts))
        return
    config = check(config)
    jobs = [
        (task, world, agent)
        for world in load_worlds(config)
        for task in config.tasks
        for agent in agents_for(config, task)
    ]
    entries = []
    for number, (task, world, agent) in enumerate(jobs, 1):
        started = time.monotonic()
        entry, read = make_entry(config.out / "entries", task, world, agent, config.episodes, config.batch)
        entries.append(entry)
        duration = "read" if read else f"{time.monotonic() - started:.0f} s"
        success = 100.0 * entry.records.success.mean()
        _progress.print(f"{number}/{len(jobs)} {task}, {world.title}, {agent}: {success:.1f} % ({duration})")
    facts = {**environment_facts(), **constants_facts(), "episodes": config.episodes}
    rows, overall = report.scores(entries), report.totals(entries)
    write_file(config.out / "leaderboard.json", report.as_json(rows, overall, facts).encode())
    write_file(config.out / "leaderboard.md", report.as_markdown(rows, overall, facts).encode())
    write_file(config.out / "leaderboard.png", report.as_png(rows, facts))
    print(config.out / "leaderboard.md")


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake, 130 for an interrupt, after which a run can go on."""
    again = "interrupted; the same command goes on"
    return run_main("leaderboard", LeaderboardConfig, run, description=__doc__, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
