"""How late the B2 obeys: the lags that `subterra_jax.b2.surrogate` has as its defaults.

`python -m benchmarks.b2_lag` has robots walk in MuJoCo, steered along the centreline by commands to which noise is
added, and fits what they did.
"""

import dataclasses
import sys
from dataclasses import dataclass

import numpy as np
import tyro
from jaxtyping import Float

from benchmarks.command import status
from scene.arguments import parse
from subterra_jax.b2.film import Driver
from subterra_jax.b2.gym import B2Env
from subterra_jax.b2.policy import RELEASED
from subterra_jax.b2.surrogate import identify
from subterra_jax.errors import SubterraError
from train import cli

_SPEEDS = (0.0, 0.3, 0.5, 0.8)  # m/s, one of them for two seconds at a time
_TURN = 0.3  # rad/s, largest noise of the yaw rate, for 0.6 s at a time


class LagError(SubterraError):
    """Nothing can be fitted."""


@dataclass(frozen=True)
class Command:
    """Identifies the lags of a gait.

    Example: python -m benchmarks.b2_lag --robots 6 --steps 150

    Attributes:
        policy: The gait: a file, the name of a released one, or `trot`.
        robots: How many walk, one after another.
        steps: Of 0.2 s, of each.
        seed: Of their draws and of the noise.
    """

    policy: str = RELEASED
    robots: int = 6
    steps: int = 150
    seed: int = 0


def walk(
    env: B2Env, driver: Driver, seed: int, n_steps: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """One robot: what it was told and what it did, speed (m/s) and yaw rate (rad/s); until it is at an end."""
    rng, period = np.random.default_rng(seed), float(env.params.vehicle.period)
    obs, _ = env.reset(seed=seed)
    driver.reset()
    told, done = [], []
    position, heading = np.array(env.state.position), float(env.state.heading)
    speed = turn = 0.0
    for k in range(n_steps):
        if k % 10 == 0:
            speed = float(rng.choice(_SPEEDS))
        if k % 3 == 0:
            turn = float(rng.uniform(-_TURN, _TURN))
        limit = float(env.env.action_space(env.params).high[1])
        action = np.array([speed, np.clip(driver.act(obs)[1] + turn, -limit, limit)], np.float32)
        obs, _, terminated, truncated, _ = env.step(action)
        place, faced = np.array(env.state.position), float(env.state.heading)
        turned = (faced - heading + np.pi) % (2.0 * np.pi) - np.pi
        middle = heading + 0.5 * turned
        ahead = float(np.sum((place - position) * [np.cos(middle), np.sin(middle)]))
        told.append(action)
        done.append([ahead / period, turned / period])
        position, heading = place, faced
        if terminated or truncated:
            break
    return np.array(told, np.float64), np.array(done)


def command(arguments: Command) -> None:
    """Walks, fits, prints.

    Raises:
        LagError: A number is out of range, or nothing can be fitted.
    """
    for name, least in (("robots", 1), ("steps", 1), ("seed", 0)):
        if getattr(arguments, name) < least:
            raise LagError(f"{name} must be at least {least}, got {getattr(arguments, name)}")
    env = B2Env(policy=arguments.policy)
    driver = Driver(env, "dead-reckoning")
    walks = [walk(env, driver, arguments.seed + k, arguments.steps) for k in range(arguments.robots)]
    told, done = (np.concatenate(parts) for parts in zip(*walks, strict=True))
    try:
        lag = identify(told, done, float(env.params.vehicle.period))
    except ValueError as cause:
        raise LagError(f"gait {arguments.policy}: {cause}") from cause
    cut = sum(len(part) < arguments.steps for part, _ in walks)
    cli.table(f"gait {arguments.policy}", {**dataclasses.asdict(lag), "steps": len(told), "ended_early": cut})


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m benchmarks.b2_lag")


def main() -> None:
    """Entry point of `python -m benchmarks.b2_lag`."""
    arguments = parse(_read)
    sys.exit(status(lambda: command(arguments)))


if __name__ == "__main__":
    main()
