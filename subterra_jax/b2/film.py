"""Films a walking B2: `python -m subterra_jax.b2.film run.webp --scene build/tunnel --seconds 20`."""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

from subterra_jax import policies
from subterra_jax.adapters.kernel import first_cpu
from subterra_jax.b2.gait import RELEASED
from subterra_jax.b2.gym import B2Env
from subterra_jax.baselines.agent import Agent
from subterra_jax.host.command import INPUT_ERRORS, parse, run_command
from subterra_jax.host.files import require_file
from subterra_jax.pictures.renderer import PictureError
from subterra_jax.recorder.trace import N_POSE, drive

_EVERY = 3  # control periods of 20 ms per picture
_DURATION = 20 * _EVERY  # time of a picture on screen, ms
_ANIMATED = (".gif", ".webp")
_MOST_PIXELS, _LONGEST = 4096, 3600.0  # s


def film(env: B2Env, agent: Agent, seconds: float, seed: int = 0) -> list[np.ndarray]:
    """Films an episode: one picture of `(height, width, 3)` uint8 per 60 ms; fewer if the episode ends before.

    Raises:
        PictureError: There is no OpenGL.
    """
    steps = max(round(seconds / float(env.task_params.vehicle.period)), 1)
    with jax.default_device(first_cpu()):
        trace = drive(env.task_env, env.task_params, agent, seed, steps=steps)
    poses = trace.pose[1:].reshape(-1, N_POSE)
    return [env.camera.draw(pose) for pose in poses[::_EVERY]]


def write(path: Path, pictures: list[np.ndarray]) -> None:
    """Writes a film in the format of its ending: `.webp`; `.gif`, ten times as large; `.mp4`, which needs ffmpeg.

    Raises:
        PictureError: The format cannot be written here.
    """
    try:
        import imageio.v3 as imageio

        options = {"duration": _DURATION, "loop": 0} if path.suffix in _ANIMATED else {"fps": 1000 / _DURATION}
        imageio.imwrite(path, np.stack(pictures), **options)
    except (ImportError, OSError, ValueError, TypeError) as cause:
        raise PictureError(f"{path} cannot be written: {cause}; .webp and .gif need imageio, .mp4 ffmpeg") from cause


def _check(settings: argparse.Namespace) -> None:
    """Checks the settings before minutes are spent on filming.

    Raises:
        ValueError: A number is out of range.
        OutputError: The file cannot be written.
    """
    for name, least, most in (("width", 16, _MOST_PIXELS), ("height", 16, _MOST_PIXELS), ("seed", 0, 2**31 - 1)):
        if not least <= getattr(settings, name) <= most:
            raise ValueError(f"{name} must be {least} to {most}, got {getattr(settings, name)}")
    if not 0.0 < settings.seconds <= _LONGEST:
        raise ValueError(f"seconds must be above 0 and at most {_LONGEST:g}, got {settings.seconds}")
    require_file(settings.out, *_ANIMATED, ".mp4")


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    parser = argparse.ArgumentParser(prog="python -m subterra_jax.b2.film", description=__doc__)
    parser.add_argument("out", type=Path, help="file to write: .webp, .gif or .mp4")
    parser.add_argument("--scene", type=Path, help="built scene folder to walk in; the packaged tunnel if left out")
    parser.add_argument("--policy", default=RELEASED, help="gait: a file, the name of a released one, or trot")
    parser.add_argument("--agent", default="dead-reckoning", help="who steers: a baseline, or a policy's file or name")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=360)
    settings = parse(parser.parse_args, arguments)

    def act() -> None:
        _check(settings)
        size = {"width": settings.width, "height": settings.height}
        env = B2Env(scene=settings.scene, policy=settings.policy, render_mode="rgb_array", **size)
        agent = policies.open_agent(settings.agent, env.task_env, env.task_params)
        pictures = film(env, agent, settings.seconds, settings.seed)
        write(settings.out, pictures)
        env.close()
        print(f"{settings.out}: {len(pictures)} pictures")

    return run_command(act, mistakes=INPUT_ERRORS)


if __name__ == "__main__":
    sys.exit(main())
