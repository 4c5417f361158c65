"""Record an episode for SLAM programs: MCAP with ROS 2 messages, TUM, and the truth apart.

Example: python -m subterra_jax.recorder --task StopAt --agent dead-reckoning --seed 7 --imu --out out/episode
"""

import sys

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.errors import MissingLibraryError
from subterra_jax.recorder import RecorderConfig, record


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""

    def act() -> None:
        try:
            import tyro
        except ImportError as error:
            raise MissingLibraryError("subterra_jax.recorder", "tyro") from error
        config = parse(
            lambda words: tyro.cli(
                RecorderConfig, args=words, prog="python -m subterra_jax.recorder", description=__doc__
            ),
            arguments,
        )
        trace = record(config)
        print(f"{len(trace)} steps, {trace.ended}: {config.recording_folder}, {config.truth_folder}")

    return run_command(act, "interrupted: nothing was written")


if __name__ == "__main__":
    sys.exit(main())
