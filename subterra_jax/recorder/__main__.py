"""Record an episode for SLAM programs: MCAP with ROS 2 messages, TUM, and the truth apart.

Example: python -m subterra_jax.recorder --task StopAt --agent dead-reckoning --seed 7 --imu --out out/episode
"""

import sys

from subterra_jax.adapters.missing import MissingLibraryError
from subterra_jax.arguments import parse
from subterra_jax.errors import SubterraError
from subterra_jax.recorder import Recording, record


def main(arguments: list[str] | None = None) -> int:
    """The command line; a user's mistake is one sentence and status 2."""
    try:
        try:
            import tyro
        except ImportError as error:
            raise MissingLibraryError("subterra_jax.recorder", "tyro") from error
        config = parse(
            lambda words: tyro.cli(Recording, args=words, prog="python -m subterra_jax.recorder", description=__doc__),
            sys.argv[1:] if arguments is None else arguments,
        )
        trace = record(config)
    except SubterraError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        return 130
    ended = "success" if trace.success else "contact" if trace.contact else "no success"
    print(f"{len(trace.command)} steps, {ended}: {config.recording_folder}, {config.truth_folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
