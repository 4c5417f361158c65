"""`python -m subterra_jax.viewer`: shows episodes in the browser."""

import argparse
import logging
import sys
import time
import warnings
from pathlib import Path
from typing import Any

from subterra_jax.host.cache import cache_folder
from subterra_jax.host.command import INPUT_ERRORS, parse, run_command
from subterra_jax.viewer.config import LOOPBACK, ViewerConfig, ViewerError

_EXAMPLE = "example: python -m subterra_jax.viewer --scene build/tunnel --task StopAt --driver particle-filter"


def parse_arguments(arguments: list[str] | None = None) -> ViewerConfig:
    """Read a command line.

    Raises:
        SystemExit: The command line is malformed, or help was shown.
    """
    parser = argparse.ArgumentParser(
        prog="python -m subterra_jax.viewer", description="Shows episodes in the browser.", epilog=_EXAMPLE
    )
    add = parser.add_argument
    add("--scene", type=Path, metavar="DIR", help="scene folder of scene.build: its lining, track and tunnel")
    many: dict[str, Any] = {"action": "append", "default": []}
    add("--tunnel", dest="tunnels", metavar="NAME|FILE", help="offer another tunnel; may be repeated", **many)
    add("--lining", metavar="NAME", help="pockets (default), smooth or furnished")
    add("--task", metavar="ID", help="first task, as StopAt or Subterra/StopAt-v1 (the default)")
    add("--sensor", metavar="NAME", help="planar16 (default), spin16x64, vlp16, os1-64 or avia")
    drivers = "first driver: a baseline, policy:NAME|FILE|RUN-FOLDER, module:Class or FILE.py:Class"
    add("--driver", dest="agent", metavar="NAME", help=drivers)
    add("--policy", dest="policies", type=Path, metavar="FILE", help="offer this policy as driver too", **many)
    add("--seed", type=int, metavar="N", help="seed of the first episode")
    add("--recordings", type=Path, metavar="DIR", help="folder for saved episodes and pictures")
    add("--replay", type=Path, metavar="FILE", help="begin with this recorded episode")
    add("--host", metavar="ADDRESS", help="address to listen on; the default is this machine alone")
    add("--port", type=int, metavar="N", help="first port to try")
    given = {name: value for name, value in vars(parse(parser.parse_args, arguments)).items() if value is not None}
    return ViewerConfig(**{**given, "tunnels": tuple(given["tunnels"]), "policies": tuple(given["policies"])})


def main(arguments: list[str] | None = None) -> int:
    """Run the viewer; return the exit status."""
    config = parse_arguments(arguments)
    return run_command(lambda: _serve(config), mistakes=INPUT_ERRORS)


def _serve(config: ViewerConfig) -> None:
    # Malformed messages are refused silently: a traceback for each would bury the others.
    for name in ("websockets.server", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    try:
        from subterra_jax.viewer.session import Viewer
    except ModuleNotFoundError as error:
        raise ViewerError(f"{error.name} is not installed: pip install 'subterra-jax[viewer]'") from error
    _compile_once()
    viewer = Viewer(config)
    print(f"{viewer.url}  (Ctrl-C ends it)", flush=True)
    if config.host not in (LOOPBACK, "localhost", "::1"):
        print(
            f"listening on {config.host}: everyone who reaches this address can drive and save in {config.recordings}"
        )
    try:
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        viewer.stop()


def _compile_once() -> None:
    """Compute on the CPU, which suits one episode, and keep compiled programs on disk."""
    import jax

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_compilation_cache_dir", str(cache_folder("viewer")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


if __name__ == "__main__":
    sys.exit(main())
