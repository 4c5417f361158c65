"""`python -m benchmarks.fidelity run|controls|sweep|calibrate|split|report`."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.fidelity import calibrate, commands
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.split import SplitConfig, split
from scene.cli import EXIT_BAD_INPUT
from scene.cli import run as command


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
        facts = split(config.recording, config.out, config.rule)
        print(", ".join(f"{name} {count} messages" for name, count in facts["messages"].items()))

    actions: dict[str, Callable[[Any], None]] = {
        "run": commands.run, "controls": commands.run_controls, "sweep": commands.run_sweep,
        "calibrate": calibrate.run, "split": cut, "report": commands.run_report,
    }  # fmt: skip
    wrapped = {name: _flat(action) for name, action in actions.items()}

    def act() -> None:
        try:
            tyro.extras.subcommand_cli_from_dict(wrapped, description=__doc__)
        except FidelityError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(EXIT_BAD_INPUT)

    command(act)


def _flat(action: Callable[[Any], None]) -> Callable[[Any], None]:
    """The fields of an action's one configuration as flags without a prefix."""
    (name,) = [key for key in action.__annotations__ if key != "return"]
    action.__annotations__[name] = Annotated[action.__annotations__[name], tyro.conf.OmitArgPrefixes]
    return action


if __name__ == "__main__":
    main()
