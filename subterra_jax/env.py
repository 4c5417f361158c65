"""The environment: reset and step, composed of the vehicle, the LiDAR, the odometer and the rule of the task."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax import draws, odometry, plant, sensing, vehicle
from subterra_jax.rules import Rule, Step, Traverse
from subterra_jax.state import EnvParams, ResetNoise, State, StepNoise
from subterra_jax.tunnel import Tunnel, at_station, foot

Info = dict[str, Any]
ESTIMATE, REPORT = 4, 5  # numbers in an action that holds an estimate, and in one that reports


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
class TunnelEnv:
    """A robot with a LiDAR and an odometer in a tunnel.

    The observation is 16 ranges (m; beam 0 straight ahead, the others counter-clockwise, evenly spaced over the whole
    turn), then the odometer's distance (m) and heading (rad), then what the task adds: `fields` names the parts. The
    action is forward speed (m/s) and yaw rate (rad/s); where `action_size` is 4 or 5 there follow an estimate of the
    station (m) and the log of its standard deviation, and at 5 the direction faced (that of growing station: above 0),
    none of which moves the robot. An episode ends as its rule says, with failure at contact, and is truncated at the
    horizon.

    Attributes:
        id: The Gymnasium id.
        rule: What the task asks.
        estimates: The action holds an estimate, which `info` then scores, although the task does not ask for one.
    """

    id: str
    rule: Rule = dataclasses.field(default_factory=Traverse)
    estimates: bool = False

    @property
    def action_size(self) -> int:
        """Numbers in one action."""
        return REPORT if self.rule.reports else ESTIMATE if self.estimates else 2

    def observation_size(self, params: EnvParams) -> int:
        """Numbers in one observation."""
        return params.lidar.n_beams + 2 + len(self.rule.fields(params))

    def fields(self, params: EnvParams) -> dict[str, slice]:
        """Where in an observation each named part of it is."""
        n_beams = params.lidar.n_beams
        parts = {"ranges": slice(0, n_beams), "odometry": slice(n_beams, n_beams + 2)}
        further = {name: slice(n_beams + 2 + i, n_beams + 3 + i) for i, name in enumerate(self.rule.fields(params))}
        return {**parts, **further}

    def observation_space(self, params: EnvParams) -> Box:
        """Bounds of an observation; a dead-reckoned distance has none."""
        n_beams, further = params.lidar.n_beams, self.rule.fields(params).values()
        range_max = np.max(np.asarray(params.lidar.range_max))
        low = np.concatenate([np.zeros(n_beams), [-np.inf, -np.pi], [low for low, _ in further]])
        high = np.concatenate([np.full(n_beams, range_max), [np.inf, np.pi], [high for _, high in further]])
        return Box(low.astype(np.float32), high.astype(np.float32))

    def action_space(self, params: EnvParams) -> Box:
        """Bounds of an action; `step` clips to them."""
        speed, yaw_rate = (np.max(np.asarray(v)) for v in (params.vehicle.speed_max, params.vehicle.yaw_rate_max))
        length = np.max(np.asarray(params.tunnel.length))
        low, high = [0.0, -yaw_rate, 0.0, -5.0, -1.0], [speed, yaw_rate, length, 5.0, 1.0]
        n = self.action_size
        return Box(np.array(low[:n], np.float32), np.array(high[:n], np.float32))

    def reset(self, key: PRNGKeyArray, params: EnvParams) -> tuple[Float[Array, "n_obs"], State]:
        """Begin an episode.

        Args:
            key: Source of everything that is drawn for the episode, and of the first scan's noise.
            params: The task.

        Returns:
            First observation and state.
        """
        start_key, scan_key = jax.random.split(key)
        state = self.begin(self.draw_reset(start_key, (), params), params)
        return self.observe(state, self.draw_step(scan_key, (), params), params), state

    def step(
        self, key: PRNGKeyArray, state: State, action: Float[Array, "n_action"], params: EnvParams
    ) -> tuple[Float[Array, "n_obs"], State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Take one step. It does not reset: see `AutoReset`.

        Args:
            key: Source of all that is random in a step.
            state: State before.
            action: Speed (m/s) and yaw rate (rad/s), and what `action_size` adds; clipped, NaN read as 0.
            params: The task.

        Returns:
            Observation, state, reward, terminated, truncated and info. An episode that ends at the horizon with success
            or contact is terminated, not truncated.
        """
        noise = self.draw_step(key, (), params)
        state, gain, terminated, truncated, info = self.advance(state, action, noise, params)
        return self.observe(state, noise, params), state, gain, terminated, truncated, info

    def draw_reset(self, key: PRNGKeyArray, batch: tuple[int, ...], params: EnvParams) -> ResetNoise:
        """Random numbers for a batch of resets; row i does not depend on the size of the batch."""
        return draws.draw_reset(key, batch, params)

    def draw_step(self, key: PRNGKeyArray, batch: tuple[int, ...], params: EnvParams) -> StepNoise:
        """Random numbers for one step of a batch; row i does not depend on the size of the batch."""
        return draws.draw_step(key, batch, params)

    def begin(self, noise: ResetNoise, params: EnvParams) -> State:
        """State at the start of an episode, before any scan."""
        index = None
        if noise.tunnel is not None:
            index = jnp.minimum((noise.tunnel * params.tunnel.count).astype(jnp.int32), params.tunnel.count - 1)
        tunnel = _here(params.tunnel, index)
        station, backwards, goal = self.rule.begin(noise, tunnel, params)
        x, y, tangent_x, tangent_y, _ = at_station(tunnel, station)
        lateral = params.start.lateral * noise.start[0]
        heading = jnp.arctan2(tangent_y, tangent_x) + params.start.heading * noise.start[1]
        position = jnp.stack([x - lateral * tangent_y, y + lateral * tangent_x])
        heading = vehicle.wrap(vehicle.wrap(heading) + jnp.pi * backwards)
        reading = odometry.start_odometry(noise.bias, params.odometry)
        return State(
            position=position,
            heading=heading,
            station=station,
            lateral=lateral,
            furthest=station,
            command=jnp.zeros(2),
            odometry=reading,
            steps=jnp.zeros((), jnp.int32),
            tunnel=index,
            slip=plant.begin_slip(noise, params),
            goal=goal,
            obstacles=None if params.obstacles is None or noise.seed is None else noise.seed[0],
            faults=plant.begin_faults(noise, position, heading, station, reading, params),
        )

    def advance(
        self, state: State, action: Float[Array, "n_action"], noise: StepNoise, params: EnvParams
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Everything of a step but the scan: motion, odometry, contact, reward and the end of the episode.

        Args:
            state: State before.
            action: As for `step`.
            noise: Random numbers of the step.
            params: The task.

        Returns:
            State, reward, terminated, truncated and info.
        """
        tunnel, period = _here(params.tunnel, state.tunnel), jnp.asarray(params.vehicle.period)
        command = vehicle.clip_action(action[:2], params.vehicle)
        motion, wheels = plant.motion(state, command, params)
        position, heading = vehicle.drive(state.position, state.heading, motion, period)
        place = foot(tunnel, position, state.station)
        clear = plant.clearance(tunnel, position, place.station, state, params)
        contact = vehicle.in_contact(tunnel, clear, place.station, params.vehicle)
        furthest, moved = jnp.maximum(state.furthest, place.station), motion[0] * period
        report = self._report(action, params)
        step = Step(state, tunnel, place, heading, furthest, contact, command, motion, moved, report)
        verdict = self.rule.judge(step, params)
        steps = state.steps + 1
        terminated = contact | verdict.ended
        truncated = (steps >= params.horizon) & ~terminated
        info = {
            **verdict.terms,
            **verdict.told,
            **self._estimate_info(step),
            "coverage": jnp.clip(furthest / tunnel.length, 0.0, 1.0),
            "station": place.station,
            "lateral": place.lateral,
            "half_width": place.half_width,
            "clearance": clear,
            "contact": contact,
            "success": verdict.success,
        }
        if state.faults is not None:
            info["severity"] = state.faults.severity
        reading = plant.read_odometer(state, wheels, place.tangent, noise, params)
        after = dataclasses.replace(
            state,
            position=position,
            heading=heading,
            station=place.station,
            lateral=place.lateral,
            furthest=furthest,
            command=command,
            odometry=reading,
            steps=steps,
            goal=verdict.goal,
            slip=plant.advance_slip(state, moved, noise, params),
            faults=plant.advance_faults(state, position, heading, place.station, reading, noise, params),
        )
        return after, sum(verdict.terms.values(), jnp.zeros(())), terminated, truncated, info

    def observe(
        self, state: State, noise: StepNoise, params: EnvParams, wanted: Bool[Array, ""] | bool = True
    ) -> Float[Array, "n_obs"]:
        """The observation of a state.

        Args:
            state: The state.
            noise: Random numbers of the step.
            params: The task.
            wanted: Whether anybody will look at it; where not, the ranges may be anything.

        Returns:
            Noisy ranges (m), dead-reckoned distance (m) and heading (rad), and what the task adds.
        """
        tunnel = _here(params.tunnel, state.tunnel)
        seen, further = sensing.perceive(state, tunnel, noise, params, wanted), self.rule.observe(state, tunnel)
        return jnp.concatenate([seen, jnp.stack(further)]) if further else seen

    def privileged(self, state: State, params: EnvParams) -> dict[str, Float[Array, ""]]:
        """What only a teacher or a critic may know: see `sensing.privileged`."""
        return sensing.privileged(state, _here(params.tunnel, state.tunnel))

    def _report(self, action: Float[Array, "n_action"], params: EnvParams) -> Float[Array, "3"]:
        """Estimate, log of its standard deviation and direction in an action: clipped; 0 for a NaN and where absent."""
        size = self.action_size
        if size == 2:
            return jnp.zeros(3)
        low, high = jnp.array([0.0, -5.0, -1.0]), jnp.stack([jnp.max(jnp.asarray(params.tunnel.length)), 5.0, 1.0])
        given = jnp.concatenate([action[2:size], jnp.zeros(REPORT - size)])
        return jnp.clip(jnp.where(jnp.isnan(given), 0.0, given), low, high)

    def _estimate_info(self, step: Step) -> Info:
        if self.action_size == 2:
            return {}
        return {"estimate_error": step.report[0] - step.place.station, "estimate_log_sigma": step.report[1]}


def _here(tunnel: Tunnel, index: Array | None) -> Tunnel:
    """The tunnel that an environment is in."""
    return tunnel if index is None else tunnel.pick(index)
