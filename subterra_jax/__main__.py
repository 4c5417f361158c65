"""The command `subterra`, or `python -m subterra_jax`: one name for each of the project's commands."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from subterra_jax.host.command import EXIT_BAD_INPUT, parse, run_command
from subterra_jax.host.task_ids import BENCHMARK
from subterra_jax.host.versions import VERSION

# Name: module that it runs, and its meaning. The modules outside this package come with a checkout.
COMMANDS = {
    "tasks": ("", "list the tasks"),
    "view": ("subterra_jax.viewer", "drive an episode and write it as a page for the browser"),
    "record": ("subterra_jax.recorder", "write an episode as MCAP with ROS 2 messages"),
    "train": ("train", "train a policy by PPO"),
    "board": ("benchmarks.board", "drive agents on the benchmark"),
    "bench": ("benchmarks.throughput", "measure steps a second"),
    "survey": ("scene.survey", "simulate a LiDAR survey of a tunnel"),
    "build": ("scene.build", "reconstruct a tunnel from a recording, a cloud or a survey"),
    "fidelity": ("benchmarks.fidelity", "score a reconstruction by 199 metrics"),
    "slam": ("benchmarks.slam", "run SLAM programs on recordings with truth"),
    "demo": ("benchmarks.demo", "survey, scene, trained agent and report in minutes"),
}


def main(words: Sequence[str] | None = None) -> int:
    """Run one of the commands with the words behind its name, in place of this process.

    Args:
        words: The command line behind the program's name; `None`: this process's.

    Returns:
        The exit status; 2 for a name that does not exist and for a command whose files are not installed.
    """
    words = list(sys.argv[1:] if words is None else words)
    name = parse(_read, words if words[:1] == ["tasks"] else words[:1]).command
    module, _ = COMMANDS[name]
    if not module:
        return run_command(lambda: print("\n".join(BENCHMARK)))
    root = Path(__file__).resolve().parents[1]
    path = root.joinpath(*module.split("."))
    if not path.with_suffix(".py").is_file() and not path.is_dir():
        print(f"error: subterra {name} runs from a checkout; the wheel holds subterra_jax alone", file=sys.stderr)
        return EXIT_BAD_INPUT
    search = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    sys.stdout.flush()
    os.execve(sys.executable, [sys.executable, "-m", module, *words[1:]], {**os.environ, "PYTHONPATH": search})


def _read(words: list[str]) -> argparse.Namespace:
    lines = "\n".join(f"  {name:10}{meaning}" for name, (_, meaning) in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="subterra",
        description="Navigation without GNSS in tunnels.",
        epilog=f"commands:\n{lines}\n\nExample: python -m subterra_jax tasks",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="subterra COMMAND ...",
    )
    parser.add_argument("--version", action="version", version=VERSION)
    parser.add_argument("command", choices=COMMANDS, help=argparse.SUPPRESS)
    return parser.parse_args(words or ["--help"])


if __name__ == "__main__":
    sys.exit(main())
