"""The environment: reset and step, composed of the vehicle, the LiDAR, the odometer and the reward."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax import lidar, odometry, reward, vehicle
from subterra_jax.state import EnvParams, ResetNoise, State, StepNoise
from subterra_jax.state import StartParams as StartParams
from subterra_jax.tunnel import at_station, foot

Info = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Box:
    """Bounds of a space: `low` and `high` are float32 arrays of one shape."""

    low: np.ndarray
    high: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one element."""
        return self.low.shape


@dataclasses.dataclass(frozen=True)
class TraverseEnv:
    """Drive through the tunnel without touching it.

    The observation is 16 ranges (m; beam 0 straight ahead, the others counter-clockwise, evenly spaced over the whole
    turn), then the odometer's distance (m) and heading (rad). The action is forward speed (m/s) and yaw rate (rad/s).
    The episode ends with success at 90 % coverage, with failure at contact, and is truncated at the horizon.

    Attributes:
        id: The Gymnasium id.
    """

    id: str
    action_size: int = 2

    def observation_size(self, params: EnvParams) -> int:
        """Numbers in one observation."""
        return params.lidar.n_beams + 2

    def observation_space(self, params: EnvParams) -> Box:
        """Bounds of an observation; a dead-reckoned distance has none."""
        n_beams = params.lidar.n_beams
        high = np.concatenate([np.full(n_beams, np.asarray(params.lidar.range_max)), [np.inf, np.pi]])
        low = np.concatenate([np.zeros(n_beams), [-np.inf, -np.pi]])
        return Box(low.astype(np.float32), high.astype(np.float32))

    def action_space(self, params: EnvParams) -> Box:
        """Bounds of an action; `step` clips to them."""
        high = np.array([params.vehicle.speed_max, params.vehicle.yaw_rate_max], np.float32)
        return Box(np.array([0.0, -high[1]], np.float32), high)

    def reset(self, key: PRNGKeyArray, params: EnvParams) -> tuple[Float[Array, "n_obs"], State]:
        """Begin an episode.

        Args:
            key: Source of the start pose, the episode's odometry bias and the first scan's noise.
            params: The task.

        Returns:
            First observation and state.
        """
        start_key, scan_key = jax.random.split(key)
        state = self.begin(self.draw_reset(start_key, (), params), params)
        return self.observe(state, self.draw_step(scan_key, (), params).ranges, params), state

    def step(
        self, key: PRNGKeyArray, state: State, action: Float[Array, "2"], params: EnvParams
    ) -> tuple[Float[Array, "n_obs"], State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Take one step. It does not reset: see `AutoReset`.

        Args:
            key: Source of the odometry and range noise.
            state: State before.
            action: Speed (m/s) and yaw rate (rad/s); clipped, NaN read as 0.
            params: The task.

        Returns:
            Observation, state, reward, terminated, truncated and info. An episode that ends at the horizon with success
            or contact is terminated, not truncated.
        """
        noise = self.draw_step(key, (), params)
        state, gain, terminated, truncated, info = self.advance(state, action, noise.odometry, params)
        return self.observe(state, noise.ranges, params), state, gain, terminated, truncated, info

    def draw_reset(self, key: PRNGKeyArray, batch: tuple[int, ...], params: EnvParams) -> ResetNoise:
        """Random numbers for a batch of resets; row i does not depend on the size of the batch."""
        start_key, bias_key = jax.random.split(key)
        return ResetNoise(
            start=jax.random.uniform(start_key, (*batch, 2), minval=-1.0), bias=jax.random.normal(bias_key, (*batch, 2))
        )

    def draw_step(self, key: PRNGKeyArray, batch: tuple[int, ...], params: EnvParams) -> StepNoise:
        """Random numbers for one step of a batch; row i does not depend on the size of the batch."""
        normal = jax.random.normal(key, (*batch, 2 + params.lidar.n_beams))
        return StepNoise(odometry=normal[..., :2], ranges=normal[..., 2:])

    def begin(self, noise: ResetNoise, params: EnvParams) -> State:
        """State at the start of an episode, before any scan."""
        station = jnp.asarray(params.start.station, jnp.float32)
        x, y, tangent_x, tangent_y, _ = at_station(params.tunnel, station)
        lateral = params.start.lateral * noise.start[0]
        heading = jnp.arctan2(tangent_y, tangent_x) + params.start.heading * noise.start[1]
        return State(
            position=jnp.stack([x - lateral * tangent_y, y + lateral * tangent_x]),
            heading=vehicle.wrap(heading),
            station=station,
            lateral=lateral,
            furthest=station,
            command=jnp.zeros(2),
            odometry=odometry.start_odometry(noise.bias, params.odometry),
            steps=jnp.zeros((), jnp.int32),
        )

    def advance(
        self, state: State, action: Float[Array, "2"], noise: Float[Array, "2"], params: EnvParams
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Everything of a step but the scan: motion, odometry, contact, reward and the end of the episode.

        Args:
            state: State before.
            action: Speed (m/s) and yaw rate (rad/s); clipped, NaN read as 0.
            noise: Standard normal numbers for the odometer.
            params: The task.

        Returns:
            State, reward, terminated, truncated and info.
        """
        tunnel, period = params.tunnel, jnp.asarray(params.vehicle.period)
        command = vehicle.clip_action(action, params.vehicle)
        position, heading = vehicle.drive(state.position, state.heading, command, period)
        place = foot(tunnel, position, state.station)
        contact = vehicle.in_contact(tunnel, position, place.station, params.vehicle)
        furthest = jnp.maximum(state.furthest, place.station)
        coverage = jnp.clip(furthest / tunnel.length, 0.0, 1.0)
        success = (coverage >= params.goal_coverage) & ~contact
        steps = state.steps + 1
        terms = reward.reward_terms(
            success=success,
            newly_covered=furthest - state.furthest,
            length=tunnel.length,
            lateral=place.lateral,
            half_width=place.half_width,
            command=command,
            previous=state.command,
            params=params.reward,
        )
        terminated = contact | success
        truncated = (steps >= params.horizon) & ~terminated
        info = {
            **terms,
            "coverage": coverage,
            "station": place.station,
            "lateral": place.lateral,
            "contact": contact,
            "success": success,
        }
        state = State(
            position=position,
            heading=heading,
            station=place.station,
            lateral=place.lateral,
            furthest=furthest,
            command=command,
            odometry=odometry.advance_odometry(state.odometry, command, period, noise, params.odometry),
            steps=steps,
        )
        return state, sum(terms.values(), jnp.zeros(())), terminated, truncated, info

    def observe(
        self,
        state: State,
        noise: Float[Array, "n_beams"],
        params: EnvParams,
        wanted: Bool[Array, ""] | bool = True,
    ) -> Float[Array, "n_obs"]:
        """The observation of a state.

        Args:
            state: The state.
            noise: Standard normal numbers for the ranges.
            params: The task.
            wanted: Whether anybody will look at it; where not, the ranges may be anything.

        Returns:
            Noisy ranges (m), dead-reckoned distance (m) and heading (rad).
        """
        ranges = lidar.scan(params.tunnel, state.position, state.heading, state.station, params.lidar, wanted)
        dead_reckoned = jnp.stack([state.odometry.distance, state.odometry.heading])
        return jnp.concatenate([lidar.add_noise(ranges, noise, params.lidar), dead_reckoned])
