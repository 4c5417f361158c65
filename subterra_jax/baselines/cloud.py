"""A cloud of particles along a tunnel: its motion, its weights, resampling, and its heaviest cluster."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.reckoning import command_errors, odometer_errors, odometer_fraction
from subterra_jax.baselines.scanmodel import TunnelPose, move_pose
from subterra_jax.baselines.stations import fault_sizes
from subterra_jax.baselines.wallmap import WallMap
from subterra_jax.parts.slip import WanderParams, advance_wander
from subterra_jax.state import EnvParams

_POWERS = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # exponents by which a likelihood may be flattened
_CANDIDATES = 32  # particles tried as the middle of the heaviest cluster
# As often as 10 m patches change, 1/m, in a cloud of which some particles must be right at once.
_SLIP_RATE = 0.1
_STIR = 0.001  # m; noise of a step where the model has none, so that particles do not fall together
_SPIN = 0.05  # rad in a step beyond which the robot is turning round


@struct.dataclass
class OdometerNoise:
    """Errors of an odometer that a cloud weighs apart, where its particles move by the command."""

    step_sigma: float  # standard deviation of the noise of one step, m
    bias_sigma: float  # standard deviation of the relative error that lasts an episode, 1
    wander: WanderParams  # the relative error that changes along the way
    turn_sigma: float = 0.0  # standard deviation of what half a turn adds to the relative error, 1

    @property
    def variance(self) -> float:
        """Variance of the relative error before any step."""
        return self.bias_sigma**2 + self.wander.sigma**2


@struct.dataclass
class CloudParams:
    """Motion and resampling of a cloud."""

    # standard deviation of the relative error of dead reckoning that lasts an episode, 1
    scale_sigma: float | Float[Array, ""]
    wander: WanderParams  # the relative error that changes along the way
    step_sigma: float | Float[Array, ""] = 0.01  # standard deviation of the noise of one step of dead reckoning, m
    # rate at which a particle changes between dry and wet rail, 1/m; 0 is never
    slip_rate: float | Float[Array, ""] = 0.0
    slip_loss: float | Float[Array, ""] = 0.3  # fraction of the speed lost on wet rail, 1
    ess_fraction: float = 0.5  # the cloud is resampled when its effective size falls below this fraction
    # Fraction to which one scan may reduce the effective size. A likelihood that would reduce it further is flattened,
    # so that chance does not select a few particles of a sparse cloud.
    least_fraction: float = 0.5
    roughening: float = 0.0005  # standard deviation of the noise on the lasting scale error of a resampled particle, 1
    jitter: float = 0.2  # standard deviation of the noise on its station, in lengths of the cloud over its particles
    cluster: float = 0.6  # half the length of one cluster, m: half the shortest distance at which a wall repeats
    # the odometer, where it is weighed apart; None where it is part of the dead reckoning
    odometer: OdometerNoise | None = None


def commanded_cloud(params: EnvParams) -> CloudParams:
    """Return the motion of a cloud that moves by commands and weighs the odometer apart; on the host."""
    lasting, changing = command_errors(params)
    bias, wandering = odometer_errors(params)
    length = lambda wander: 30.0 if wander is None else float(wander.length)  # noqa: E731
    backward = params.odometry.backward_bias_sigma
    return dataclasses.replace(
        cloud_params(params),
        scale_sigma=lasting,
        wander=WanderParams(changing, length(params.slip.wander if "slip" in params.parts else None)),
        step_sigma=_STIR,
        odometer=OdometerNoise(
            max(_STIR, float(params.odometry.distance_sigma)),
            bias,
            WanderParams(wandering, length(params.odometry.wander)),
            0.0 if backward is None else float(backward),
        ),
    )


def cloud_params(params: EnvParams) -> CloudParams:
    """Return the motion of a cloud for the nominal errors of a task; on the host."""
    fraction = odometer_fraction(params)
    (lasting, changing), (plant_lasting, plant_changing) = odometer_errors(params), command_errors(params)
    fused = lambda a, b: float(np.hypot(fraction * a, (1.0 - fraction) * b))  # noqa: E731
    wander = params.slip.wander if "slip" in params.parts else params.odometry.wander
    return CloudParams(
        scale_sigma=fused(lasting, plant_lasting),
        wander=WanderParams(fused(changing, plant_changing), 30.0 if wander is None else float(wander.length)),
        step_sigma=max(0.005, fraction * float(params.odometry.distance_sigma)),
        slip_rate=_SLIP_RATE if "faults" in params.parts else 0.0,
        slip_loss=float(fault_sizes(params).wet_loss),
    )


@struct.dataclass
class Cloud:
    """Particles."""

    pose: TunnelPose  # pose of each particle
    scale: Float[Array, "n"]  # lasting relative error of dead reckoning, 1
    wander: Float[Array, "n"]  # changing relative error, 1
    wet: Float[Array, "n"]  # 1 where the particle assumes wet rail, else 0
    log_weight: Float[Array, "n"]  # log of the weight; the weights sum to 1 after `reweight`
    # mean and variance of the odometer's relative error, given the particle's way; None where the odometer is not
    # weighed apart
    odometer: Float[Array, "n 2"] | None = None


def new_cloud(key: PRNGKeyArray, pose: TunnelPose, params: CloudParams) -> Cloud:
    """Makes particles at given poses, `(n,)`, with random scale errors and equal weights."""
    n = pose.station.shape[0]
    normal = jax.random.normal(key, (2, n))
    return Cloud(
        pose=pose,
        scale=params.scale_sigma * normal[0],
        wander=params.wander.sigma * normal[1],
        wet=jnp.zeros(n),
        log_weight=jnp.full(n, -jnp.log(float(n))),
        odometer=None if params.odometer is None else jnp.tile(jnp.asarray([0.0, params.odometer.variance]), (n, 1)),
    )


def move(
    key: PRNGKeyArray,
    cloud: Cloud,
    walls: WallMap,
    travelled: Float[Array, ""],
    turned: Float[Array, ""],
    params: CloudParams,
) -> Cloud:
    """Moves a cloud by a dead-reckoned distance, m, and turn, rad; NaN is unknown, and replaced by that of the axis."""
    n = cloud.scale.shape[0]
    normal = jax.random.normal(key, (2, n))
    flips = jax.random.uniform(jax.random.fold_in(key, 1), (n,)) < params.slip_rate * jnp.abs(travelled)
    wet = jnp.where(flips, 1.0 - cloud.wet, cloud.wet)
    grip = 1.0 - params.slip_loss * wet
    distance = travelled * (1.0 + cloud.scale + cloud.wander) * grip + params.step_sigma * normal[0]
    after = move_pose(cloud.pose, distance, turned, walls.curvature(cloud.pose.station)[2])
    wander = jax.vmap(advance_wander, (0, None, 0, None))(cloud.wander, travelled, normal[1], params.wander)
    return dataclasses.replace(cloud, pose=after, wander=wander, wet=wet)


def weigh_odometer(
    cloud: Cloud, commanded: Float[Array, ""], read: Float[Array, ""], turned: Float[Array, ""], params: CloudParams
) -> tuple[Cloud, Float[Array, "n"]]:
    """Computes the log likelihood of an odometer's step for each particle's way, and learns the odometer's error.

    A Kalman filter of the relative error for each particle, whose way is given; the odometer counts wheels, on wet rail
    too.

    Args:
        cloud: The cloud, before it moves.
        commanded: Commanded distance of the step, m; `read` is that of the odometer.
        turned: Step of its heading, rad; NaN where the odometer stands, which tells nothing.

    Returns:
        The cloud with the errors that it has learnt, and the log likelihood up to a constant.
    """
    noise = params.odometer
    assert noise is not None
    assert cloud.odometer is not None
    way = commanded * (1.0 + cloud.scale + cloud.wander)
    mean, variance = cloud.odometer.T
    spin = jnp.where(jnp.abs(turned) > _SPIN, jnp.abs(turned) / jnp.pi, 0.0)
    news = 2.0 * noise.wander.sigma**2 / noise.wander.length * jnp.abs(commanded) + noise.turn_sigma**2 * spin
    variance = jnp.minimum(variance + news, noise.variance + noise.turn_sigma**2)
    rest, total = read - way * (1.0 + mean), way * way * variance + noise.step_sigma**2
    gain = way * variance / total
    learnt = jnp.stack([mean + gain * rest, variance * (1.0 - gain * way)], axis=-1)
    known = ~jnp.isnan(turned)
    likely = jnp.where(known, -0.5 * (rest * rest / total + jnp.log(total)), 0.0)
    return dataclasses.replace(cloud, odometer=jnp.where(known, learnt, cloud.odometer)), likely


def reweight(cloud: Cloud, gain: Float[Array, "n"], params: CloudParams) -> Cloud:
    """Multiplies the weights by a likelihood, flattened where it would leave too few particles; `gain` is its log."""
    options = _normalise(cloud.log_weight + jnp.asarray(_POWERS)[:, None] * gain)
    enough = _effective_size(options) >= params.least_fraction * gain.shape[0]
    # The largest power that leaves enough particles, or else the least.
    chosen = jnp.where(jnp.any(enough), jnp.argmax(enough), len(_POWERS) - 1)
    return dataclasses.replace(cloud, log_weight=options[chosen])


def _normalise(log_weight: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
    return log_weight - jax.scipy.special.logsumexp(log_weight, axis=-1, keepdims=True)


def _effective_size(log_weight: Float[Array, "*m n"]) -> Float[Array, "*m"]:
    return 1.0 / jnp.sum(jnp.exp(2.0 * log_weight), axis=-1)


def resample(key: PRNGKeyArray, cloud: Cloud, params: CloudParams) -> Cloud:
    """Resamples a cloud by its weights where too few particles carry them; systematically, in order.

    Source: Arulampalam et al. 2002, A tutorial on particle filters for online nonlinear/non-Gaussian Bayesian tracking;
    for the jitter, Gordon et al. 1993, Novel approach to nonlinear/non-Gaussian Bayesian state estimation.
    """
    n = cloud.scale.shape[0]
    weight = jnp.exp(cloud.log_weight)
    due = _effective_size(cloud.log_weight) < params.ess_fraction * n
    offset_key, rough_key = jax.random.split(key)
    total = jnp.cumsum(weight)
    point = (jnp.arange(n) + jax.random.uniform(offset_key)) / n * total[-1]
    drawn = jnp.clip(jnp.searchsorted(total, point), 0, n - 1)
    parent = jnp.where(due, drawn, jnp.arange(n))
    heirs = jax.tree.map(lambda leaf: leaf[parent], cloud)
    normal = jnp.where(due, jax.random.normal(rough_key, (2, n)), 0.0)
    length = jnp.max(heirs.pose.station) - jnp.min(heirs.pose.station)
    pose = dataclasses.replace(heirs.pose, station=heirs.pose.station + params.jitter * length / n * normal[0])
    log_weight = jnp.where(due, -jnp.log(float(n)), cloud.log_weight)
    return dataclasses.replace(
        heirs, pose=pose, scale=heirs.scale + params.roughening * normal[1], log_weight=log_weight
    )


def summarise(cloud: Cloud, params: CloudParams) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Finds the heaviest cluster of a cloud.

    Returns:
        Its mean station (m), the standard deviation of all particles about it (m), and its heading against the tangent
        of growing station (rad, in [-π, π]).
    """
    weight, station = jnp.exp(cloud.log_weight), cloud.pose.station
    # Clusters that face opposite ways lie apart, however near their stations are.
    cos, sin = jnp.cos(cloud.pose.heading), jnp.sin(cloud.pose.heading)
    stride = max(1, station.shape[0] // _CANDIDATES)
    first = slice(stride // 2, None, stride)
    near = jnp.abs(station - station[first, None]) < params.cluster
    near &= cos * cos[first, None] > 0.0
    mass = jnp.sum(jnp.where(near, weight, 0.0), axis=1)
    best = jnp.argmax(mass)
    inside = jnp.where(near[best], weight, 0.0)
    fraction = jnp.maximum(mass[best], 1e-12)
    mean = lambda value: jnp.sum(inside * value) / fraction  # noqa: E731
    middle = mean(station)
    sigma = jnp.sqrt(jnp.sum(weight * (station - middle) ** 2))
    return middle, sigma, jnp.arctan2(mean(sin), mean(cos))
