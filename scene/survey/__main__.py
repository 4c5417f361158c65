"""`python -m scene.survey --length 60 --seed 0 --out DIR`: write a simulated survey and its truth."""

import sys

import tyro
from rich.console import Console

from scene.survey.config import SurveyConfig, check_survey
from scene.survey.simulate import simulate
from subterra_jax.host.command import INPUT_ERRORS, parse, run_command


def main(args: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    config = parse(lambda words: tyro.cli(SurveyConfig, prog="python -m scene.survey", args=words), args)

    def act() -> None:
        check_survey(config)
        print(simulate(config, Console(stderr=True)))

    return run_command(act, mistakes=INPUT_ERRORS)


if __name__ == "__main__":
    sys.exit(main())
