"""An inertial measurement unit: specific force and turn rate, several times between two steps."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax import constants as c
from subterra_jax.lidar3d.space import ground_at, level_axes
from subterra_jax.parts.part import Batch, Bounds, Keys, Noise, Part, SensingState, Step
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import at_station

GRAVITY = 9.81  # m/s²


@struct.dataclass
class ImuParams:
    """Errors and rate of an IMU at the robot's middle. Source of the densities: the Avia's BMI088 in GEODE.

    Attributes:
        accel_density: Noise density of specific force, m/s²/√Hz.
        gyro_density: Noise density of the turn rate, rad/s/√Hz.
        accel_walk: Random walk of its bias, m/s²/√s.
        gyro_walk: Random walk of its bias, rad/s/√s.
        accel_bias: Standard deviation over episodes of the first bias in each axis, m/s².
        gyro_bias: Likewise of the turn rate, rad/s.
        samples: Samples of a step: 20 are 200 Hz at a control period of 0.1 s.
    """

    accel_density: Float[Array, ""] | float = c.IMU_ACCEL_DENSITY
    gyro_density: Float[Array, ""] | float = c.IMU_GYRO_DENSITY
    accel_walk: Float[Array, ""] | float = c.IMU_ACCEL_WALK
    gyro_walk: Float[Array, ""] | float = c.IMU_GYRO_WALK
    accel_bias: Float[Array, ""] | float = c.IMU_ACCEL_BIAS
    gyro_bias: Float[Array, ""] | float = c.IMU_GYRO_BIAS
    samples: int = struct.field(pytree_node=False, default=20)


@struct.dataclass
class ImuState:
    """Samples of the last step, and what the next ones go on from."""

    # specific force along the robot's axes ahead, left and up (m/s²) and turn rate about them (rad/s), oldest first
    samples: Float[Array, "n 6"]
    velocity: Float[Array, "3"]  # mean velocity in the last sample's interval, tunnel frame, m/s
    axes: Float[Array, "3 3"]  # axes ahead, left and up at its end, as rows, tunnel frame
    bias: Float[Array, "6"]  # present bias, as a sample


def measure(
    velocity: Float[Array, "n_after 3"], axes: Float[Array, "n_after 3 3"], interval: Float[Array, ""] | float
) -> Float[Array, "n 6"]:
    """Return what an ideal IMU gives over intervals, each the mean of its own.

    Velocity first, then position by the new velocity, `R` by the turn: so integrated, the samples give back velocities
    and axes exactly.

    Args:
        velocity: Mean velocities before the first interval and in each, tunnel frame, m/s.
        axes: Axes ahead, left and up as rows, at the beginning of the first interval and at the end of each.
        interval: Length of an interval, s.

    Returns:
        Specific force (m/s²) along the axes at the beginning of each interval, and turn rate about them (rad/s).
    """
    change = (velocity[1:] - velocity[:-1]) / interval
    change = change.at[:, 2].add(GRAVITY)
    force = jnp.sum(axes[:-1] * change[:, None, :], axis=-1)
    # Half the antisymmetric part of the turn between two axes is its sine times its axis.
    turn = jnp.sum(axes[:-1, :, None, :] * axes[1:, None, :, :], axis=-1)
    sine = 0.5 * jnp.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=-1
    )
    size = jnp.sqrt(jnp.maximum(jnp.sum(sine * sine, axis=-1, keepdims=True), 1e-24))
    return jnp.concatenate([force, sine * jnp.arcsin(jnp.minimum(size, 1.0)) / size / interval], axis=-1)


@dataclasses.dataclass(frozen=True)
class Imu(Part):
    """Specific force and turn rate, with noise and wandering biases; gravity with the grade of the ground."""

    name: ClassVar[str] = "imu"

    def defaults(self) -> dict[str, Any]:
        return {"imu": ImuParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> Float[Array, "*batch 6"]:
        return jax.random.normal(key, (*batch, 6), jnp.float32)

    def normals(self, params: EnvParams) -> int:
        return 6 * (params.imu.samples + 1)

    def begin(self, draw: Float[Array, "6"], state: State, params: EnvParams) -> ImuState:
        axes = _axes(params.tunnel.pick(state.tunnel), state.station, state.heading)
        rest = measure(jnp.zeros((2, 3)), jnp.stack([axes, axes]), 1.0)
        bias = _sizes(params.imu.accel_bias, params.imu.gyro_bias) * draw
        return ImuState(jnp.repeat(rest, params.imu.samples, axis=0) + bias, jnp.zeros(3), axes, bias)

    def advance(self, own: ImuState, step: Step, noise: Noise, params: EnvParams) -> ImuState:
        n, period, sensor = params.imu.samples, jnp.asarray(params.vehicle.period), params.imu
        interval = period / n
        speed, rate = step.drive.motion[0], step.drive.motion[1]
        middle = (jnp.arange(n, dtype=jnp.float32) + 0.5) * interval
        end = (jnp.arange(n, dtype=jnp.float32) + 1.0) * interval
        heading = step.before.heading + rate * middle
        half = 0.5 * rate * interval
        level = speed * jnp.where(jnp.abs(half) < 1e-3, 1.0 - half * half / 6.0, jnp.sin(half) / _not_zero(half))
        x, y = level * jnp.cos(heading), level * jnp.sin(heading)
        along = (step.place.station - step.before.station) / period
        here = step.before.station + along * middle
        _, rise = jax.vmap(ground_at, (None, 0))(step.tunnel, here)
        velocity = jnp.concatenate([own.velocity[None], jnp.stack([x, y, rise * along], axis=-1)])
        place, turned = step.before.station + along * end, step.before.heading + rate * end
        axes = jax.vmap(_axes, (None, 0, 0))(step.tunnel, place, turned)
        axes = jnp.concatenate([own.axes[None], axes])
        true = measure(velocity, axes, interval)
        drawn = noise.normal.reshape(n + 1, 6)
        bias = own.bias + _sizes(sensor.accel_walk, sensor.gyro_walk) * jnp.sqrt(period) * drawn[-1]
        white = _sizes(sensor.accel_density, sensor.gyro_density) * jnp.sqrt(1.0 / interval) * drawn[:-1]
        return ImuState(true + bias + white, velocity[-1], axes[-1], bias)

    def observe(self, own: ImuState, sensing: SensingState, noise: Noise, params: EnvParams) -> dict[str, Array]:
        """Return `imu`: the samples of the last step, one after another."""
        return {"imu": sensing.parts[self.name].samples.reshape(-1)}

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        n = 6 * params.imu.samples
        return {"imu": (np.full(n, -np.inf), np.full(n, np.inf))}

    def check(self, others: frozenset[str], params: EnvParams) -> None:
        """Refuse a number of samples below 1.

        Raises:
            ValueError: There is no sample.
        """
        if params.imu.samples < 1:
            raise ValueError(f"the imu needs one sample a step or more, got samples={params.imu.samples}")


def _sizes(accel: Any, gyro: Any) -> Float[Array, "6"]:
    return jnp.concatenate([jnp.full(3, accel), jnp.full(3, gyro)])


def _not_zero(value: Array) -> Array:
    return jnp.where(jnp.abs(value) < 1e-3, 1.0, value)


def _axes(tunnel: Any, station: Array, heading: Array) -> Float[Array, "3 3"]:
    _, rise = ground_at(tunnel, station)
    _, _, tangent_x, tangent_y, _ = at_station(tunnel, station)
    return jnp.stack([jnp.stack(axis) for axis in level_axes(rise, tangent_x, tangent_y, heading)])
