"""Least squares over a chain of knots: everything that was measured, and the trajectory of least cost."""

from dataclasses import dataclass, replace

import numpy as np

from scene.poses import chain as chains
from scene.poses import headings
from scene.poses.chain import Chain, Motion
from scene.poses.leastsquares import NormalEquations
from scene.poses.terms import Sightings, Steps

_YAWS = np.deg2rad(np.arange(0, 360, 45))
_TRIAL = 60.0  # s of the recording on which the mounting's heading is tried out
_TRIAL_ITERATIONS, _ITERATIONS = 8, 25
_CONVERGED = 1e-6  # rad and m
_BIAS = (0.02, 0.3)  # rad/s, m/s²: what a MEMS gyro and accelerometer may start with
_NO_BIAS = (1e-6, 1e-6)
# Standard deviation of a position against the mean of two velocities, m: jerk · step³ / 12 of a walker's stride.
_SMOOTH, SMOOTH_BETWEEN_SWEEPS = 2e-4, 5e-3


@dataclass(frozen=True)
class Noise:
    """What the instruments are trusted to.

    Attributes:
        control: Standard deviation of a control position in each axis, m.
        gyro: Of one sample, rad/s. Source: GEODE, device γ.
        accel: Of one sample, m/s²; the published figure times 3, for scale and alignment errors that nobody models.
        gyro_walk, accel_walk: Of the biases, per √s.
        robust: Standard deviations beyond which a measurement counts ever less.
    """

    control: float = 0.003
    gyro: float = 5.144e-3
    accel: float = 3 * 5.574e-3
    gyro_walk: float = 1.088e-4
    accel_walk: float = 1.208e-4
    robust: float = 4.0


@dataclass(frozen=True)
class Problem:
    """Everything that was measured, on one chain of knots.

    Attributes:
        motion: Rates and forces between knots.
        sightings: Of the prism.
        steps: Of the odometry, where it ran.
        noise: See `Noise`.
        inertial: Whether the rates come from an instrument, which has biases; otherwise the motion is merely smooth.
    """

    motion: Motion
    sightings: Sightings
    steps: Steps | None
    noise: Noise
    inertial: bool = True

    def solve(self, chain: Chain, iterations: int = _ITERATIONS) -> tuple[Chain, float]:
        """The chain of least cost near `chain`, and that cost."""
        damping, cost = 1e-6, np.inf
        best = chain
        for _ in range(iterations):
            equations = self._equations(chain)
            if equations.cost < cost:
                best, cost, damping = chain, equations.cost, max(damping / 10, 1e-9)
                step = equations.solve(damping)
                accepted = equations
            else:
                damping *= 100
                step = accepted.solve(damping)
            chain = best.moved(step)
            if np.abs(step[:, :6]).max() < _CONVERGED:
                break
        return best, cost

    def _equations(self, chain: Chain) -> NormalEquations:
        reach = 1 if self.steps is None else int((self.steps.second - self.steps.first).max())
        equations = NormalEquations(len(chain.times), chains.SIZE, reach)
        noise = self.noise
        if self.inertial:
            chains.add_motion(equations, chain, self.motion, _SMOOTH)
            chains.add_biases(equations, chain, _BIAS, (noise.gyro_walk, noise.accel_walk))
        else:
            chains.add_motion(equations, chain, self.motion, SMOOTH_BETWEEN_SWEEPS)
            chains.add_biases(equations, chain, _NO_BIAS, _NO_BIAS)
        self.sightings.add_to(equations, chain, noise.robust)
        if self.steps is not None:
            self.steps.add_to(equations, chain, noise.robust)
        return equations


def solve_with_heading(problem: Problem, chain: Chain) -> Chain:
    """Solves from every mounting of the body about the vertical on the first minute, then the whole from the best."""
    n = min(len(chain.times), int(np.searchsorted(chain.times, chain.times[0] + _TRIAL)) + 1)
    short, piece = _first(problem, chain, n)
    trials = [short.solve(_turned(piece, short.sightings.lever, yaw), _TRIAL_ITERATIONS)[1] for yaw in _YAWS]
    guess = _turned(chain, problem.sightings.lever, float(_YAWS[int(np.argmin(trials))]))
    return problem.solve(guess)[0]


def _turned(chain: Chain, lever: np.ndarray, yaw: float) -> Chain:
    attitude = headings.along_track(chain.times, chain.attitude, chain.velocity, yaw)
    prism = chain.position + chain.attitude @ lever
    return replace(chain, attitude=attitude, position=prism - attitude @ lever)


def _first(problem: Problem, chain: Chain, n: int) -> tuple[Problem, Chain]:
    """The first `n` knots and what was measured between them."""
    motion, seen, steps = problem.motion, problem.sightings, problem.steps
    near = seen.knot < n - 1
    if steps is not None:
        kept = steps.second < n
        fields = (steps.first, steps.second, steps.turn, steps.shift, steps.turn_root, steps.shift_root)
        steps = Steps(*(values[kept] for values in fields))
    short = replace(
        problem,
        motion=replace(motion, rate=motion.rate[: n - 1], force=motion.force[: n - 1]),
        sightings=replace(seen, knot=seen.knot[near], share=seen.share[near], position=seen.position[near]),
        steps=steps,
    )
    state = (chain.attitude, chain.position, chain.velocity, chain.gyro_bias, chain.accel_bias)
    return short, Chain(chain.times[:n], *(values[:n] for values in state))
