"""Bound on the error along the tunnel of whoever reads one scan with a map: what the walls give away.

Channels of a beam hold independent normal noise, so that one scan knows the station to 1 / sqrt(sum of g² / (σ² + v)).
Ranges jump at edges, where they have no slope: g is the slope of the best line through the values about a station
(statistical linearisation), and v, what the line leaves over, counts as noise. Source: Särkkä 2013, Bayesian Filtering
and Smoothing, section 5.

Offset and heading count as known, so that nobody does better. Slopes of ranges below `LEAST_SLOPE` count as none: no
program knows a wall to the millimetre before it has driven past.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import range_sigma
from subterra_jax.env import Env
from subterra_jax.parts import Noise
from subterra_jax.parts.brightness import SCALE_SIGMA
from subterra_jax.state import EnvParams
from subterra_jax.tunnel import beside

LEAST_SLOPE = 0.005  # 1
BLUR = 0.05  # m, spread of the stations about the true one
PLACES = np.array([-1.6, -0.8, 0.0, 0.8, 1.6]) * BLUR  # m; standard deviation 1.13 times the blur
_ROUNDING = 1.0 / 12.0  # variance of a whole number


class Localisability(NamedTuple):
    """Bounds of one scan.

    Attributes:
        station: Stations, m.
        by_range: Bound of the station by ranges alone, m; `inf` where they tell nothing.
        bound: Bound with intensities too, where the LiDAR gives them, m.
    """

    station: Float[np.ndarray, "n"]
    by_range: Float[np.ndarray, "n"]
    bound: Float[np.ndarray, "n"]


def localisability(env: Env, params: EnvParams, step: float = 1.0, index: int = 0) -> Localisability:
    """Compute the bound in the middle of a tunnel, facing along the axis.

    Args:
        params: Its params: tunnel, LiDAR, texture of the walls.
        step: Distance between stations, m.
        index: Number of the tunnel in a stack.

    Raises:
        ValueError: `step` is not positive, or there is no such tunnel.
    """
    count = params.tunnel.count
    if not (step > 0.0 and 0 <= index < count):
        raise ValueError(f"step must be positive and index below {count}, got step={step:g} and index={index}")
    station = np.arange(0.5 * step, float(params.tunnel.pick(index).length), step)
    places = jnp.asarray(station[:, None] + PLACES, jnp.float32)
    sensor = params.lidar
    seen = {name: np.asarray(values, np.float64) for name, values in look_along(env, params, places, index).items()}
    ranges = seen["ranges" if "ranges" in seen else "scan"]
    limit = float(np.max(np.asarray(sensor.range_max)))
    there = (ranges < limit).all(axis=1)
    slope, left = fit_slopes(ranges.swapaxes(0, 1))
    slope = np.where(there & (np.abs(slope) >= LEAST_SLOPE), slope, 0.0)
    information = np.sum(slope**2 / (range_sigma(params) ** 2 + left), axis=1)
    more = np.zeros_like(information)
    if "intensity" in seen:
        shown = seen["intensity"]
        slope, left = fit_slopes(shown.swapaxes(0, 1))
        noise = (SCALE_SIGMA * shown.mean(axis=1)) ** 2 + _ROUNDING
        more = np.sum(np.where(there, slope**2 / (noise + left), 0.0), axis=1)
    with np.errstate(divide="ignore"):
        return Localisability(station, information**-0.5, (information + more) ** -0.5)


def fit_slopes(values: Float[np.ndarray, "k *n"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Return the slope of each value over the `PLACES`, per m, and the variance about the line."""
    middle = values - values.mean(axis=0)
    slope = np.tensordot(PLACES, middle, axes=1) / (PLACES @ PLACES)
    line = PLACES.reshape(-1, *[1] * slope.ndim) * slope
    return slope, np.mean((middle - line) ** 2, axis=0)


def look_along(env: Any, params: EnvParams, places: Float[Array, "n k"], index: int) -> dict[str, Array]:
    """Return what the LiDAR shows at stations on the axis without noise, by channel, `(n, k, beams)`."""
    sensor = params.lidar
    if hasattr(sensor, "echo"):
        echo = sensor.echo.replace(sigma=0.0, sigma_per_metre=0.0, sigma_slant=0.0, losing=False, mixing=False)
        params = params.replace(lidar=sensor.replace(echo=echo, range_min=0.0))
    drawn = env.draw_step(jax.random.key(0), (), params)
    still = jax.tree.map(jnp.zeros_like, drawn["lidar"])
    _, state = env.reset(jax.random.key(0), params)
    tunnel = params.tunnel.pick(index)
    fields = env.fields(params)
    shown = [name for name in ("ranges", "scan", "intensity") if name in fields]

    @jax.jit
    def many(stations: Array) -> dict[str, Array]:
        def one(at: Array) -> dict[str, Array]:
            position, heading = beside(tunnel, at, jnp.zeros(()))
            own = state.replace(
                position=position, heading=heading, station=at, lateral=jnp.zeros(()), tunnel=jnp.int32(index)
            )
            flat = env.observe(own, {**drawn, "lidar": Noise(still.normal, still.uniform)}, params)
            return {name: flat[fields[name]] for name in shown}

        return jax.lax.map(jax.vmap(one), stations)

    return many(places)
