"""`python -m scene.survey --length 60 --seed 0 --out DIR`: write a simulated survey and its truth."""

import sys

import tyro
from rich.console import Console

from scene.arguments import parse
from scene.survey.config import SurveyConfig, check_survey
from scene.survey.simulate import simulate


def main(args: list[str] | None = None) -> int:
    """Run the command; return its exit status, 2 for what the user can put right."""
    config = parse(lambda words: tyro.cli(SurveyConfig, prog="python -m scene.survey", args=words), args)
    try:
        check_survey(config)
        print(simulate(config, Console(stderr=True)))
    except (ValueError, OSError) as error:
        told = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.strerror else error
        print(f"error: {told}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
