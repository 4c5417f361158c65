"""Identifies the lags of a B2 gait, the defaults of `subterra_jax.b2.transfer`: `python -m benchmarks.b2_lag`.

Robots walk along the centreline in MuJoCo under commands with added noise; lags and gains are fitted to their motion.
"""

import dataclasses
import sys
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.command import BenchmarkError, require_least, run_main
from subterra_jax.b2.film import Driver
from subterra_jax.b2.gait import RELEASED
from subterra_jax.b2.gym import B2Env
from subterra_jax.b2.transfer import identify
from train.log import print_table

_SPEEDS = (0.0, 0.3, 0.5, 0.8)  # m/s; one is drawn every 2 s
_TURN = 0.3  # rad/s; largest noise of the yaw rate, drawn every 0.6 s


@dataclass(frozen=True)
class Command:
    """Identifies the lags of a gait.

    Example: python -m benchmarks.b2_lag --robots 6 --steps 150

    Attributes:
        policy: Gait: a file, the name of a released gait, or `trot`.
        robots: Number of robots, one after another.
        steps: Steps of 0.2 s for each robot.
        seed: Seed for robots and noise.
    """

    policy: str = RELEASED
    robots: int = 6
    steps: int = 150
    seed: int = 0


def walk(
    env: B2Env, driver: Driver, seed: int, n_steps: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Walks one robot to the end of its episode; returns commands and motion as speed (m/s) and yaw rate (rad/s)."""
    rng, period = np.random.default_rng(seed), float(env.params.vehicle.period)
    obs, _ = env.reset(seed=seed)
    driver.reset()
    commands, motion = [], []
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
        last_position, last_heading = position, heading
        position, heading = np.array(env.state.position), float(env.state.heading)
        angle = (heading - last_heading + np.pi) % (2.0 * np.pi) - np.pi
        middle = last_heading + 0.5 * angle
        ahead = float(np.sum((position - last_position) * [np.cos(middle), np.sin(middle)]))
        commands.append(action)
        motion.append([ahead / period, angle / period])
        if terminated or truncated:
            break
    return np.array(commands, np.float64), np.array(motion)


def command(arguments: Command) -> None:
    """Walks the robots, fits the lags and prints them.

    Raises:
        BenchmarkError: A number is out of range, or the lags cannot be identified.
    """
    require_least(arguments, robots=1, steps=1, seed=0)
    env = B2Env(policy=arguments.policy)
    driver = Driver(env, "dead-reckoning")
    walks = [walk(env, driver, arguments.seed + k, arguments.steps) for k in range(arguments.robots)]
    commands, motion = (np.concatenate(parts) for parts in zip(*walks, strict=True))
    try:
        lag = identify(commands, motion, float(env.params.vehicle.period))
    except ValueError as cause:
        raise BenchmarkError(f"gait {arguments.policy}: {cause}") from cause
    ended_early = sum(len(part) < arguments.steps for part, _ in walks)
    print_table(
        f"gait {arguments.policy}", {**dataclasses.asdict(lag), "steps": len(commands), "ended_early": ended_early}
    )


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("b2_lag", Command, command, words=words)


if __name__ == "__main__":
    sys.exit(main())
