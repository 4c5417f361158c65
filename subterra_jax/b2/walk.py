"""The environment in which the B2 learns to walk on a track: reset, step, servos and reward terms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import draws, gait, observation
from subterra_jax.b2.model import B2
from subterra_jax.b2.observation import gravity_direction, locate, true_velocity
from subterra_jax.b2.params import WalkParams, WalkResetNoise, WalkState, WalkStepNoise
from subterra_jax.env import Box, Info
from subterra_jax.physics.engine import Body, Build, Engine
from subterra_jax.physics.riding import Ride, advance_period, has_tipped

N_ACTION, N_SENSOR = 12, 30  # sizes of an action, and of the noise of the sensors
_STIFFNESS, _DAMPING, _TORQUE = (
    np.tile(np.array([getattr(b2.JOINT[part], name) for part in b2.PARTS], np.float32), 4)
    for name in ("stiffness", "damping", "torque")
)


@dataclasses.dataclass(frozen=True, eq=False)
class WalkEnv:
    """A Unitree B2 on the track of a tunnel that follows velocity commands.

    The action is twelve joint offsets in [-1, 1], in the order of `constants.JOINTS`. They are scaled by
    `params.action_scale` and added to the targets of a trot that follows the command. The zero action walks, and
    stands where the command is 0. The observation is proprioception: rates, gravity, velocity from the legs, the
    command and its slewed form, the clock of the gait, joints, last action; `fields` names the parts. An episode is
    terminated by a fall, and truncated at the horizon or at an end of the tunnel. Walls stop the robot; `info` gives
    the contact.

    Attributes:
        id: The Gymnasium id.
        physics: The engine with the robot.
        driven: Whether commands are set from outside, in the state, instead of drawn.
        privileged: Whether the observation ends with the truth for a critic.
    """

    id: str = "Subterra/B2Walk-v1"
    physics: Engine = dataclasses.field(default_factory=lambda: Engine(B2))
    driven: bool = False
    privileged: bool = False

    def observation_size(self, params: WalkParams) -> int:
        """Return the size of one observation."""
        return max(part.stop for part in self.fields(params).values())

    def fields(self, params: WalkParams) -> dict[str, slice]:
        """Return the slice of each named part of an observation."""
        sizes = {**observation.FIELDS, **(observation.PRIVILEGED if self.privileged else {})}
        ends = np.cumsum(list(sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}

    def skips_unneeded(self, params: WalkParams) -> bool:
        """Tell that every observation is made."""
        return False

    def observation_space(self, params: WalkParams) -> Box:
        """Return the bounds of an observation: none."""
        size = self.observation_size(params)
        return Box(np.full(size, -np.inf, np.float32), np.full(size, np.inf, np.float32))

    def action_space(self, params: WalkParams) -> Box:
        """Return the bounds of an action; `step` clips to them."""
        return Box(-np.ones(N_ACTION, np.float32), np.ones(N_ACTION, np.float32))

    def reset(self, key: PRNGKeyArray, params: WalkParams) -> tuple[Float[Array, "n_obs"], WalkState]:
        """Begins an episode anywhere along the tunnel; returns first observation and state."""
        start_key, sense_key = jax.random.split(key)
        state = self.begin(self.draw_reset(start_key, (), params), params)
        return self.observe(state, self.draw_step(sense_key, (), params), params), state

    def step(
        self, key: PRNGKeyArray, state: WalkState, action: Float[Array, "12"], params: WalkParams
    ) -> tuple[Float[Array, "n_obs"], WalkState, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Advances by one control period of 20 ms. It does not reset: see `AutoReset`.

        The action is clipped to [-1, 1], a NaN read as 0. Returns observation, state, reward, terminated, truncated
        and info.
        """
        noise = self.draw_step(key, (), params)
        state, reward, terminated, truncated, info = self.advance(state, action, noise, params)
        return self.observe(state, noise, params), state, reward, terminated, truncated, info

    def draw_reset(self, key: PRNGKeyArray, batch: tuple[int, ...], params: WalkParams) -> WalkResetNoise:
        """Draws random numbers for a batch of resets; row i does not depend on the size of the batch."""
        uniform = jax.random.uniform(key, (*batch, 38 + N_SENSOR), minval=-1.0)
        return WalkResetNoise(
            place=uniform[..., :5], build=uniform[..., 5:34], command=uniform[..., 34:38], sensor=uniform[..., 38:]
        )

    def draw_step(self, key: PRNGKeyArray, batch: tuple[int, ...], params: WalkParams) -> WalkStepNoise:
        """Draws random numbers for one step of a batch; row i does not depend on the size of the batch."""
        uniform = jax.random.uniform(key, (*batch, N_SENSOR + 8), minval=-1.0)
        return WalkStepNoise(sensor=uniform[..., :N_SENSOR], command=uniform[..., N_SENSOR:-3], push=uniform[..., -3:])

    def begin(self, noise: WalkResetNoise, params: WalkParams) -> WalkState:
        """Return the state at the start of an episode."""
        return draws.begin(noise, params)

    def advance(
        self, state: WalkState, action: Float[Array, "12"], noise: WalkStepNoise, params: WalkParams
    ) -> tuple[WalkState, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Computes all of a step except the observation: state, reward, terminated, truncated and info."""
        period = self.physics.period
        action = jnp.clip(jnp.where(jnp.isnan(action), 0.0, action), -1.0, 1.0)
        gait_state, targets = command_joints(state, action, period, params)
        pushed = Ride(_push(state.body, noise, period, params), state.anchor)
        ride, _, clear, wrong = advance_period(self.physics, pushed, targets, state.build, params.track, params.tunnel)
        body, anchor = ride.body, ride.anchor
        pose = locate(body, params.track.quaternion[anchor])
        fallen = wrong | (pose.height < params.fall_height) | has_tipped(body, params.fall_tilt)
        torque = servo_torques(body, targets, state.build)
        terms = reward_terms(body, gait_state, torque, action, state.action, fallen, params, period)
        station = params.track.station[anchor] + pose.ahead
        furthest, steps = jnp.maximum(state.furthest, station), state.steps + 1
        expired, ends = steps >= params.horizon, params.track.station
        outside = (station < ends[0]) | (station > ends[-1])
        proprioception = observation.measure(
            body, noise.sensor, state.proprioception.velocity, gait_state, params.sensor, params.gait
        )
        after = dataclasses.replace(
            state,
            body=body,
            anchor=anchor,
            gait=gait_state,
            action=action,
            proprioception=proprioception,
            furthest=furthest,
            steps=steps,
        )
        if not self.driven:
            drawn, command = draws.next_command(state, pose, noise, period, params)
            after = dataclasses.replace(after, drawn_command=drawn, command=command)
        info = {
            **terms,
            "station": station,
            "lateral": pose.lateral,
            "height": pose.height,
            "coverage": jnp.clip(furthest / params.tunnel.length, 0.0, 1.0),
            "clearance": clear,
            "contact": clear < self.physics.reach,
            "fall": fallen,
            "success": expired & ~fallen,
            "velocity": true_velocity(body),
            "asked": gait_state.velocity,
            "effort": jnp.sum(jnp.abs(torque * body.qvel[6:])),
        }
        return after, sum(terms.values(), jnp.zeros(())), fallen, (expired | outside) & ~fallen, info

    def observe(
        self, state: WalkState, noise: WalkStepNoise | None, params: WalkParams, needed: Bool[Array, ""] | bool = True
    ) -> Float[Array, "n_obs"]:
        """Return the observation of a state, which holds it already; `noise` and `needed` change nothing."""
        own = observation.observe_self(state)
        return jnp.concatenate([own, observation.observe_truth(state, params.track)]) if self.privileged else own


def _push(body: Body, noise: WalkStepNoise, period: float, params: WalkParams) -> Body:
    arrives = 0.5 * (noise.push[2] + 1.0) < period / params.randomisation.push_every
    kick = jnp.where(arrives, params.randomisation.push * noise.push[:2], 0.0)
    return dataclasses.replace(body, qvel=body.qvel.at[:2].add(kick))


def command_joints(
    state: WalkState, action: Float[Array, "12"], period: float, params: WalkParams
) -> tuple[gait.GaitState, Float[Array, "12"]]:
    """Advances the gait, and computes the servo targets: those of the gait plus the action's offsets, rad."""
    sensors = state.proprioception
    drift = jnp.concatenate([sensors.velocity, sensors.rates[2:]]) - state.gait.velocity
    gait_state = gait.advance(state.gait, state.command, drift, period, params.gait)
    offset = jnp.tile(jnp.asarray(params.action_scale), 4) * action
    return gait_state, gait.targets(gait_state, sensors.gravity, params.gait) + offset


def servo_torques(body: Body, targets: Float[Array, "12"], build: Build) -> Float[Array, "12"]:
    """Computes the torques of the position servos, N m."""
    torque = build.stiffness * _STIFFNESS * (targets - body.qpos[7:]) - build.damping * _DAMPING * body.qvel[6:]
    return jnp.clip(torque, -_TORQUE, _TORQUE)


def reward_terms(
    body: Body,
    gait_state: gait.GaitState,
    torque: Float[Array, "12"],
    action: Float[Array, "12"],
    last_action: Float[Array, "12"],
    fallen: Bool[Array, ""],
    params: WalkParams,
    period: float,
) -> dict[str, Float[Array, ""]]:
    """Computes the reward of one control period, by term.

    Args:
        body: State at the end of the period.
        gait_state: The gait, which holds the slewed command and says which feet should stand.
        torque: Torques of the servos, N m.
        action: Action of this period.
        last_action: Action of the period before.
        fallen: Whether the robot has fallen.
        params: The task, with the weights in `reward`.
        period: Length of the control period, s.
    """
    weights, gravity = params.reward, gravity_direction(body)
    error = true_velocity(body) - gait_state.velocity
    width = weights.width * weights.width
    change = action - last_action
    rates = {
        "velocity": weights.velocity * jnp.exp(-(error[0] * error[0] + error[1] * error[1]) / width),
        "yaw_rate": weights.yaw_rate * jnp.exp(-error[2] * error[2] / width),
        "alive": jnp.asarray(weights.alive),
        "bounce": weights.bounce * body.qvel[2] * body.qvel[2],
        "roll": weights.roll * (body.qvel[3] * body.qvel[3] + body.qvel[4] * body.qvel[4]),
        "tilt": weights.tilt * (gravity[0] * gravity[0] + gravity[1] * gravity[1]),
        "effort": weights.effort * jnp.sum(torque * torque),
        "jerk": weights.jerk * jnp.sum(change * change),
        "action": weights.action * jnp.sum(action * action),
        "slip": weights.slip * _slip(body, gravity, gait_state, params.gait),
    }
    # A falling robot may move at any speed; the clip bounds its penalty.
    terms = {f"reward_{name}": jnp.clip(rate, -10.0, 10.0) * period for name, rate in rates.items()}
    return {**terms, "reward_fall": jnp.where(fallen, weights.fall, 0.0)}


def _slip(
    body: Body, gravity: Float[Array, "3"], gait_state: gait.GaitState, params: gait.GaitParams
) -> Float[Array, ""]:
    """Sum over the feet that should stand of their squared speed over ground, m²/s²."""
    angles, speeds = body.qpos[7:], body.qvel[6:]
    standing = gait.stance(gait_state, params)
    velocities = [
        observation.leg_velocity(body.qvel[3:6], gravity, angles, speeds, jnp.zeros(4).at[leg].set(1.0))
        for leg in range(len(b2.LEGS))
    ]
    error = jnp.stack(velocities) - true_velocity(body)[:2]
    return jnp.sum(standing * jnp.sum(error * error, axis=1))
