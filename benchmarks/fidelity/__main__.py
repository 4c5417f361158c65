"""How good a reconstruction is, in 18 categories.

Example: python -m benchmarks.fidelity run --scene build/tunnel --recording held_out.bag --trajectory poses.tum
"""

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.fidelity import calibrate, commands
from benchmarks.fidelity.split import SplitConfig, split
from scene.arguments import parse
from scene.cli import run as command

_PROG = "python -m benchmarks.fidelity"


@dataclass(frozen=True)
class SplitCommand:
    """Cut a recording into fit, val and hold by blocks of time.

    Attributes:
        recording: A bag.
        out: Folder to write.
        rule: How it is cut.
    """

    recording: tyro.conf.Positional[Path]
    out: Path
    rule: SplitConfig = field(default_factory=SplitConfig)


def main() -> None:
    """Runs one command; a user's mistake is one sentence and status 2."""
    if len(sys.argv) == 1:
        sys.argv.append("run")

    def cut(config: SplitCommand) -> None:
        """Cut a recording into fit, val and hold by blocks of time.

        Example: python -m benchmarks.fidelity split recording.bag --out build/parts
        """
        facts = split(config.recording, config.out, config.rule)
        print(", ".join(f"{name} {count} messages" for name, count in facts["messages"].items()))

    actions: dict[str, Callable[[Any], None]] = {
        "run": commands.run, "controls": commands.run_controls, "sweep": commands.run_sweep,
        "calibrate": calibrate.run, "split": cut, "report": commands.run_report,
    }  # fmt: skip
    wrapped = {name: _flat(action) for name, action in actions.items()}

    def act() -> None:
        parse(
            lambda words: tyro.extras.subcommand_cli_from_dict(wrapped, args=words, prog=_PROG, description=__doc__)
        )()

    command(act)


def _flat(action: Callable[[Any], None]) -> Callable[[Any], Callable[[], None]]:
    """An action, still to be run, whose one configuration's fields are flags without a prefix."""
    (name,) = [key for key in action.__annotations__ if key != "return"]

    @functools.wraps(action)
    def later(config: Any) -> Callable[[], None]:
        return lambda: action(config)

    later.__annotations__ = {"config": Annotated[action.__annotations__[name], tyro.conf.OmitArgPrefixes]}
    del later.__wrapped__  # else its signature would be the action's
    return later


if __name__ == "__main__":
    main()
