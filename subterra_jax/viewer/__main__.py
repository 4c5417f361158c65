"""`python -m subterra_jax.viewer`: drives an episode and writes it as a page for the browser."""

import argparse
import sys
import webbrowser
from pathlib import Path

from subterra_jax.host.command import INPUT_ERRORS, parse, run_command
from subterra_jax.host.errors import MissingLibraryError, SubterraError
from subterra_jax.host.files import require_file

_EXAMPLE = "example: python -m subterra_jax.viewer --task StopAt --driver particle-filter --out out/view.html --open"


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read a command line.

    Raises:
        SystemExit: The command line is malformed, or help was shown.
    """
    parser = argparse.ArgumentParser(
        prog="python -m subterra_jax.viewer",
        description="Drives an episode and writes it as one HTML file, which any browser plays.",
        epilog=_EXAMPLE,
    )
    add = parser.add_argument
    add("--task", default="StopAt", metavar="ID", help="as StopAt (default), Subterra/StopAt-v1 or FILE.py:ID")
    drivers = "a baseline (dead-reckoning is the default), policy:NAME|FILE|RUN-FOLDER, module:Class or FILE.py:Class"
    add("--driver", default="dead-reckoning", metavar="NAME", help=drivers)
    add("--tunnel", metavar="NAME|FILE", help="tunnel; the first of the task's own if left out")
    add("--scene", type=Path, metavar="DIR", help="scene folder of scene.build, whose tunnel is driven")
    add("--lining", metavar="NAME", help="pockets, smooth or furnished")
    add("--motion", default="wheels", metavar="NAME", help="wheels (default), or rover: by physics, in MuJoCo")
    add("--sensor", default="planar16", metavar="NAME", help="planar16 (default), spin16x64, vlp16, os1-64 or avia")
    add("--seed", type=int, default=0, metavar="N", help="seed of the episode")
    add("--steps", type=int, metavar="N", help="steps at most; the task's horizon if left out")
    add("--out", type=Path, default=Path("out/view.html"), metavar="FILE", help="page to write (out/view.html)")
    add("--open", action="store_true", help="open it in the browser")
    return parse(parser.parse_args, arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    settings = parse_arguments(arguments)
    return run_command(lambda: view(settings), "interrupted: nothing was written", INPUT_ERRORS)


def view(settings: argparse.Namespace) -> None:
    """Drive the episode of a command line and write its page.

    Raises:
        SubterraError: A file, task or driver is not available, or a value is out of range.
    """
    try:
        from subterra_jax.viewer.page import write_page
    except ModuleNotFoundError as missing:
        raise MissingLibraryError("subterra_jax.viewer", missing.name or "viser", "viewer") from missing
    from subterra_jax.host.task_ids import MISSIONS, WALK
    from subterra_jax.parts.spatial_lidar import SENSORS
    from subterra_jax.policies import open_agent
    from subterra_jax.recorder.config import open_place
    from subterra_jax.recorder.trace import drive
    from subterra_jax.tasks import find
    from subterra_jax.viewer.episode import draw
    from subterra_jax.viewer.shapes import planar_shapes

    task, sensor, out = find(settings.task, short=True), settings.sensor, require_file(settings.out, ".html")
    if task == WALK:
        raise SubterraError(f"{WALK} has no episode to show; {MISSIONS[0]} has")
    if sensor not in SENSORS:
        raise SubterraError(f"no sensor {sensor!r}; there are {', '.join(SENSORS)}")
    if not 0 <= settings.seed < 2**32:
        raise SubterraError(f"seed must be 0 to {2**32 - 1}, got {settings.seed}")
    if settings.steps is not None and settings.steps < 1:
        raise SubterraError(f"steps must be at least 1, got {settings.steps}")
    world = open_place(task, settings.tunnel, settings.scene, settings.lining, sensor, settings.motion)
    env, params, plan, lining = world.env, world.params, world.plan, settings.lining or world.plan.default_lining
    trace = drive(env, params, open_agent(settings.driver, env, params), settings.seed, steps=settings.steps)
    facts = {
        "task": env.id,
        "driver": settings.driver,
        "tunnel": f"{plan.name}, {lining}, {plan.length:.0f} m",
        "seed": str(settings.seed),
    }
    write_page(out, draw(env, params, plan, trace), planar_shapes(plan, lining), float(params.vehicle.radius), facts)
    print(f"{len(trace)} steps, {trace.ended}: {out}")
    if settings.open:
        webbrowser.open(out.resolve().as_uri())


if __name__ == "__main__":
    sys.exit(main())
