"""The environment in which the B2 learns to walk on a track: reset and step, with the contract of every other task."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.b2 import begin, driver, observation, payment, servos, window
from subterra_jax.b2.feel import feel, gravity_seen
from subterra_jax.b2.params import WalkParams, WalkResetNoise, WalkState, WalkStepNoise
from subterra_jax.b2.physics import BUMPER_RADIUS, BUMPERS, Body, Physics, Surroundings
from subterra_jax.b2.rotation import rotate
from subterra_jax.env import Box, Info
from subterra_jax.tunnel import at_station
from subterra_jax.vehicle import clearance

N_ACTION = 12


@dataclasses.dataclass(frozen=True, eq=False)
class WalkEnv:
    """A Unitree B2 on the track of a tunnel, told how fast to walk.

    The action is twelve joint offsets in [-1, 1], in the order of `constants.JOINTS`, scaled by `params.action_scale`
    and added to the targets of a trot that follows the command: the zero action walks, and stands where that is 0.
    The observation is what the robot feels of itself: rates, gravity, the speed its legs tell, the command and what of
    it is being obeyed, the clock of the gait, joints, last action; `fields` names the parts. An episode is terminated
    by a fall and truncated at the horizon or at an end of the tunnel. Walls stop the robot and are told as contact.

    Attributes:
        id: The Gymnasium id.
        physics: The robot on its window of track.
        driven: The command is set from outside, in the state, and not drawn.
        privileged: The observation is followed by what only a critic may know.
    """

    id: str = "Subterra/B2Walk-v0"
    physics: Physics = dataclasses.field(default_factory=Physics)
    driven: bool = False
    privileged: bool = False

    def observation_size(self, params: WalkParams) -> int:
        """Numbers in one observation."""
        return sum(observation.sizes(self.privileged).values())

    def fields(self, params: WalkParams) -> dict[str, slice]:
        """Where in an observation each named part of it is."""
        sizes = observation.sizes(self.privileged)
        ends = np.cumsum(list(sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}

    def observation_space(self, params: WalkParams) -> Box:
        """Bounds of an observation: none."""
        size = self.observation_size(params)
        return Box(np.full(size, -np.inf, np.float32), np.full(size, np.inf, np.float32))

    def action_space(self, params: WalkParams) -> Box:
        """Bounds of an action; `step` clips to them."""
        return Box(-np.ones(N_ACTION, np.float32), np.ones(N_ACTION, np.float32))

    def reset(self, key: PRNGKeyArray, params: WalkParams) -> tuple[Float[Array, "n_obs"], WalkState]:
        """Begin an episode anywhere along the tunnel.

        Args:
            key: Source of everything that is drawn.
            params: The task.

        Returns:
            First observation and state.
        """
        start_key, sense_key = jax.random.split(key)
        state = self.begin(self.draw_reset(start_key, (), params), params)
        return self.observe(state, self.draw_step(sense_key, (), params), params), state

    def step(
        self, key: PRNGKeyArray, state: WalkState, action: Float[Array, "12"], params: WalkParams
    ) -> tuple[Float[Array, "n_obs"], WalkState, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Take one control period of 20 ms. It does not reset: see `AutoReset`.

        Args:
            key: Source of all that is random in it.
            state: Before.
            action: Joint offsets; clipped to [-1, 1], NaN read as 0.
            params: The task.

        Returns:
            Observation, state, reward, terminated, truncated and info.
        """
        noise = self.draw_step(key, (), params)
        state, gain, terminated, truncated, info = self.advance(state, action, noise, params)
        return self.observe(state, noise, params), state, gain, terminated, truncated, info

    def draw_reset(self, key: PRNGKeyArray, batch: tuple[int, ...], params: WalkParams) -> WalkResetNoise:
        """Random numbers for a batch of resets; row i does not depend on the size of the batch."""
        return begin.draw_reset(key, batch)

    def draw_step(self, key: PRNGKeyArray, batch: tuple[int, ...], params: WalkParams) -> WalkStepNoise:
        """Random numbers for one step of a batch; row i does not depend on the size of the batch."""
        return begin.draw_step(key, batch)

    def begin(self, noise: WalkResetNoise, params: WalkParams) -> WalkState:
        """State at the start of an episode."""
        return begin.begin(noise, params)

    def advance(
        self, state: WalkState, action: Float[Array, "12"], noise: WalkStepNoise, params: WalkParams
    ) -> tuple[WalkState, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Everything of a step but the observation.

        Args:
            state: Before.
            action: As for `step`.
            noise: Random numbers of the step.
            params: The task.

        Returns:
            State, reward, terminated, truncated and info.
        """
        period = self.physics.period
        action = jnp.clip(jnp.where(jnp.isnan(action), 0.0, action), -1.0, 1.0)
        walking, targets = servos.command_joints(state, action, period, params)
        around = self.surroundings(state, params)
        body = self.physics.run(_pushed(state.body, noise, period, params), targets, around, state.build)
        sound = jnp.all(jnp.isfinite(body.qpos)) & jnp.all(jnp.isfinite(body.qvel))
        body = jax.tree.map(lambda new, old: jnp.where(sound, new, old), body, state.body)
        anchor, position = window.follow(params.track, state.anchor, body.qpos[:3])
        body = dataclasses.replace(body, qpos=body.qpos.at[:3].set(position))
        place = driver.locate(body, params.track.quaternion[anchor])
        upright = -gravity_seen(body)[2]
        fallen = ~sound | (place.height < params.fall_height) | (upright < jnp.cos(params.fall_tilt))
        torque = servos.torques(body, targets, state.build)
        terms = payment.terms(body, walking, torque, action, state.action, fallen, params.reward, params.gait, period)
        station = params.track.station[anchor] + place.ahead
        furthest, steps = jnp.maximum(state.furthest, station), state.steps + 1
        expired, outside = steps >= params.horizon, self._outside(station, params)
        feeling = feel(body, noise.sensor, state.feeling.velocity, walking, params.sensor, params.gait)
        after = dataclasses.replace(
            state,
            body=body,
            anchor=anchor,
            gait=walking,
            action=action,
            feeling=feeling,
            furthest=furthest,
            steps=steps,
        )
        if not self.driven:
            wanted, command = begin.drive(state, place, noise, period, params)
            after = dataclasses.replace(after, wish=wanted, command=command)
        clear = self._clearance(after, station, params)
        info = {
            **terms,
            "station": station,
            "lateral": place.lateral,
            "height": place.height,
            "coverage": jnp.clip(furthest / params.tunnel.length, 0.0, 1.0),
            "clearance": clear,
            "contact": clear < BUMPER_RADIUS,
            "fall": fallen,
            "success": expired & ~fallen,
            "velocity": payment.true_velocity(body),
            "asked": walking.velocity,
            "effort": jnp.sum(jnp.abs(torque * body.qvel[6:])),
        }
        return after, sum(terms.values(), jnp.zeros(())), fallen, (expired | outside) & ~fallen, info

    def observe(
        self, state: WalkState, noise: WalkStepNoise | None, params: WalkParams, wanted: Bool[Array, ""] | bool = True
    ) -> Float[Array, "n_obs"]:
        """The observation of a state: what it holds already; noise and `wanted` change nothing."""
        del noise, wanted
        felt = observation.felt(state)
        return jnp.concatenate([felt, observation.truth(state, params.track)]) if self.privileged else felt

    def surroundings(self, state: WalkState, params: WalkParams) -> Surroundings:
        """What the robot may touch in the next control period."""
        track, anchor = params.track, state.anchor
        place = driver.locate(state.body, track.quaternion[anchor])
        ground = window.poses(track, anchor, place.ahead, self.physics.window)
        half_width = at_station(params.tunnel, track.station[anchor] + place.ahead)[4]
        return Surroundings(ground, track.quaternion[anchor], half_width)

    def position(self, state: WalkState, params: WalkParams) -> Float[Array, "3"]:
        """Middle of the trunk in the tunnel frame, m."""
        return params.track.position[state.anchor] + state.body.qpos[:3]

    def _clearance(self, state: WalkState, station: Float[Array, ""], params: WalkParams) -> Float[Array, ""]:
        """From the nearer of the two discs' middles to the nearest wall, m."""
        middle = self.position(state, params)
        ends = [middle + rotate(state.body.qpos[3:7], jnp.array(place)) for place in BUMPERS]
        return jnp.minimum(*[clearance(params.tunnel, end[:2], station) for end in ends])

    def _outside(self, station: Float[Array, ""], params: WalkParams) -> Bool[Array, ""]:
        """Whether the track ends here."""
        last = params.track.station.shape[0] - 1
        return (station < params.track.station[0]) | (station > params.track.station[last])


def _pushed(body: Body, noise: WalkStepNoise, period: float, params: WalkParams) -> Body:
    """The robot after what may have hit it."""
    comes = 0.5 * (noise.push[2] + 1.0) < period / params.variety.push_every
    kick = jnp.where(comes, params.variety.push * noise.push[:2], 0.0)
    return dataclasses.replace(body, qvel=body.qvel.at[:2].add(kick))
