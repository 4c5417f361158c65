"""Times another library's trainer on a task: `python docs/examples/run.py sb3_ppo --out sb3.json`.

Each trainer has one file beside this one to copy from: its settings, the adapter, and how its policy is taken out. The
command trains until a fraction of 100 fresh episodes succeeds, then drives listed episodes once.
"""

import argparse
import dataclasses
import importlib
import json
from pathlib import Path

from watch import GOAL, Score, Watch

TRAINERS = ("brax_ppo", "sb3_ppo", "cleanrl_like", "purejaxrl_like", "rejax_ppo")


def show(score: Score) -> None:
    """Prints one score."""
    print(f"{score.steps:>9,} steps {score.seconds:7.1f} s {100.0 * score.success:5.1f} %", flush=True)


def main() -> None:
    """Trains and writes what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trainer", choices=TRAINERS)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--task", default="Subterra/TraverseShort-v1")
    parser.add_argument("--goal", type=float, default=GOAL, help="fraction of the fresh episodes")
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="listed episodes at the end")
    words = parser.parse_args()
    trainer = importlib.import_module(words.trainer)
    watch = Watch(words.task, words.goal, report=show)
    trainer.train(watch, words.steps, words.seed)
    content = {
        "trainer": words.trainer,
        "task": words.task,
        "seed": words.seed,
        "scores": [dataclasses.asdict(score) for score in watch.scores],
        "listed": watch.listed(words.episodes),
    }
    words.out.write_text(json.dumps(content, indent=1) + "\n")
    print(f"{words.trainer}: {100.0 * content['listed']['success']:.1f} % of {words.episodes} listed")


if __name__ == "__main__":
    main()
