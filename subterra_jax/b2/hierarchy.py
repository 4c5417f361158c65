"""A planar task done on four legs: five times a second a driver says `[v, ω]`, fifty times a second a gait obeys."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax import draws, lidar, odometry, vehicle
from subterra_jax.b2 import draws as walk_draws
from subterra_jax.b2 import posing, sight
from subterra_jax.b2.mission import MissionParams, MissionResetNoise, MissionState, MissionStepNoise, Tread
from subterra_jax.b2.params import WalkState, WalkStepNoise
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.env import Info, TunnelEnv
from subterra_jax.rules.rule import Step
from subterra_jax.state import EnvParams, ResetNoise, State, StepNoise
from subterra_jax.tunnel import foot
from subterra_jax.vehicle import wrap

PERIODS = 10  # of the gait's control in one of the task's


@dataclasses.dataclass(frozen=True)
class MissionEnv(TunnelEnv):
    """`TunnelEnv` on a Unitree B2: same observation, action, rules and contract; a gait and physics between.

    The LiDAR looks from where the trunk has it, tilted as the trunk is. The odometer is the robot's own: what the
    standing legs and the gyroscope tell. Episodes end as the rule says, and with a fall. Params are `MissionParams`,
    states `MissionState`.

    Attributes:
        walk: The robot, driven.
        odometer: `legs`, the robot's own; or `drift`, the model of the planar tasks applied to its true motion.
    """

    walk: WalkEnv = dataclasses.field(default_factory=lambda: WalkEnv(driven=True))
    odometer: Literal["legs", "drift"] = "legs"

    def draw_reset(self, key: PRNGKeyArray, batch: tuple[int, ...], params: EnvParams) -> MissionResetNoise:
        """Random numbers for a batch of resets; row i does not depend on the size of the batch."""
        noise = draws.draw_reset(key, batch, params)
        return MissionResetNoise(**vars(noise), walk=walk_draws.draw_reset(jax.random.fold_in(key, 2), batch))

    def draw_step(self, key: PRNGKeyArray, batch: tuple[int, ...], params: EnvParams) -> MissionStepNoise:
        """Random numbers for one step of a batch; row i does not depend on the size of the batch."""
        noise = draws.draw_step(key, batch, params)
        return MissionStepNoise(**vars(noise), walk=walk_draws.draw_step(jax.random.fold_in(key, 2), (*batch, PERIODS)))

    def begin(self, noise: ResetNoise, params: EnvParams) -> MissionState:
        """State at the start of an episode: standing where the task has its start."""
        assert isinstance(noise, MissionResetNoise)
        assert isinstance(params, MissionParams)
        plane = super().begin(noise, params)
        return MissionState(**vars(plane), walk=posing.stand(plane, noise.walk, params))

    def advance(
        self, state: State, action: Float[Array, "n_action"], noise: StepNoise, params: EnvParams
    ) -> tuple[MissionState, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Everything of a step but the scan; see `TunnelEnv.advance`.

        `info` tells also `fall`, and the `height` of the trunk over the sleepers (m). `clearance` is the least of the
        step, from the nearer of the two discs that make up the robot's envelope.
        """
        assert isinstance(state, MissionState)
        assert isinstance(params, MissionParams)
        assert isinstance(noise, MissionStepNoise)
        command = vehicle.clip_action(action[:2], params.vehicle)
        walk, tread, height = self._walk(state.walk, command, noise.walk, params)
        position, heading = posing.seen_from_above(walk, params.walk)
        place = foot(params.tunnel, position, state.station)
        contact = (tread.contact > 0.0) | _outside(place.station, params)
        fall = tread.fall > 0.0
        furthest = jnp.maximum(state.furthest, place.station)
        motion, moved = _motion(state, position, heading, params)
        report = self._report(action, params)
        step = Step(state, params.tunnel, place, heading, furthest, contact | fall, command, motion, moved, report)
        verdict = self.rule.judge(step, params)
        steps = state.steps + 1
        terminated = contact | fall | verdict.ended
        info = {
            **verdict.terms,
            **verdict.told,
            **self._estimate_info(step),
            "coverage": jnp.clip(furthest / params.tunnel.length, 0.0, 1.0),
            "station": place.station,
            "lateral": place.lateral,
            "half_width": place.half_width,
            "clearance": tread.clearance,
            "height": height,
            "contact": contact,
            "fall": fall,
            "success": verdict.success & ~fall,
        }
        after = dataclasses.replace(
            state,
            position=position,
            heading=heading,
            station=place.station,
            lateral=place.lateral,
            furthest=furthest,
            command=command,
            odometry=self._read(state, tread, motion, noise, params),
            steps=steps,
            goal=verdict.goal,
            walk=walk,
        )
        gain = sum(verdict.terms.values(), jnp.zeros(()))
        return after, gain, terminated, (steps >= params.horizon) & ~terminated, info

    def observe(
        self, state: State, noise: StepNoise, params: EnvParams, wanted: Bool[Array, ""] | bool = True
    ) -> Float[Array, "n_obs"]:
        """The observation of a state; see `TunnelEnv.observe`."""
        del wanted
        assert isinstance(state, MissionState)
        assert isinstance(params, MissionParams)
        ranges = sight.scan(state.walk, state.station, params.walk, params.lidar, params.relief)
        reading = jnp.stack([state.odometry.distance, state.odometry.heading])
        further = self.rule.observe(state, params.tunnel)
        parts = [lidar.add_noise(ranges, noise.ranges, params.lidar), reading]
        return jnp.concatenate([*parts, jnp.stack(further)] if further else parts)

    def _walk(
        self, walk: WalkState, command: Float[Array, "2"], noise: WalkStepNoise, params: MissionParams
    ) -> tuple[WalkState, Tread, Float[Array, ""]]:
        """The robot at the end of a step, what came of it, and its height, m."""
        told = jnp.stack([command[0], jnp.zeros(()), command[1]])
        walk, period = dataclasses.replace(walk, command=told), self.walk.physics.period

        def control(walk: WalkState, drawn: WalkStepNoise) -> tuple[WalkState, tuple[Tread, Array]]:
            action = jnp.zeros(12)
            if params.policy is not None:
                action = params.policy.act(self.walk.observe(walk, drawn, params.walk))
            walk, _, fall, _, info = self.walk.advance(walk, action, drawn, params.walk)
            felt = walk.proprioception
            # About the vertical, whichever way the trunk leans.
            turning = -jnp.sum(felt.rates * felt.gravity)
            contact, fell = (flag.astype(jnp.float32) for flag in (info["contact"], fall))
            tread = Tread(felt.velocity[0] * period, turning * period, info["clearance"], contact, fell)
            return walk, (tread, info["height"])

        walk, (treads, height) = lax.scan(control, walk, noise)
        tread = Tread(
            distance=jnp.sum(treads.distance),
            turn=jnp.sum(treads.turn),
            clearance=jnp.min(treads.clearance),
            contact=jnp.max(treads.contact),
            fall=jnp.max(treads.fall),
        )
        return walk, tread, height[-1]

    def _read(
        self, state: MissionState, tread: Tread, motion: Float[Array, "2"], noise: StepNoise, params: MissionParams
    ) -> odometry.OdometryState:
        """The odometer after a step."""
        before, period = state.odometry, jnp.asarray(params.vehicle.period)
        if self.odometer == "drift":
            return odometry.advance_odometry(before, motion, period, noise.odometry, params.odometry)
        turned = tread.turn + before.heading_bias * period
        return dataclasses.replace(
            before, distance=before.distance + tread.distance, heading=wrap(before.heading + turned)
        )


def _motion(
    state: State, position: Float[Array, "2"], heading: Float[Array, ""], params: MissionParams
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """What the trunk did in a step: mean speed along its mean heading (m/s) and yaw rate (rad/s); and its way, m."""
    turned = wrap(heading - state.heading)
    middle = state.heading + 0.5 * turned
    x, y = position - state.position
    ahead = x * jnp.cos(middle) + y * jnp.sin(middle)
    return jnp.stack([ahead, turned]) / params.vehicle.period, jnp.abs(ahead)


def _outside(station: Float[Array, ""], params: MissionParams) -> Bool[Array, ""]:
    """Whether the trunk's middle has left the tunnel by as much as half its length."""
    beyond = 0.5
    return (station < -beyond) | (station > params.tunnel.length + beyond)
