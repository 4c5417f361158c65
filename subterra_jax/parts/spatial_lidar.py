"""A LiDAR in three dimensions as a part of an environment; `subterra_jax.lidar3d` casts its beams."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.host.texture import brightness, wall_angle
from subterra_jax.lidar3d import beams, echo
from subterra_jax.lidar3d.casting import Met, meet, require_free, require_pattern
from subterra_jax.lidar3d.echo import EchoParams
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.lidar3d.space import Mount, into_tunnel, stand
from subterra_jax.parts.brightness import (
    DOPPLER_MOST,
    DOPPLER_SIGMA,
    FULL_SCALE,
    MOST,
    intensity,
    normal_beside,
    place_ends,
)
from subterra_jax.parts.part import Bounds, Noise, Part, SensingState, Step
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import at_station


@struct.dataclass
class SpatialParams:
    """LiDAR in three dimensions.

    Attributes:
        directions: Beams in the sensor's frame, unit vectors, row by row of the image.
        times: Time of each beam from that of the observation, s, at most 0.
        range_max: Largest range, m. A beam without a return reports exactly this.
        range_min: Least range; what is nearer gives no return, m.
        mount: Place and attitude on the robot.
        echo: Errors.
        shape: Rows and columns of the image; of a spinning sensor rings and azimuths.
        sweep: Cast each beam from the pose at its own time; otherwise all from that of the observation.
        intensity: Observe intensities too.
        full_scale: Intensity reported for a diffuse surface of 100 %.
        texture: Dial of the walls' texture, 0 to 1; `None` has none, and costs nothing.
        doppler: Observe the speed of each beam's range over the last step, m/s; positive goes away.
    """

    directions: Float[Array, "n 3"]
    times: Float[Array, "n"]
    range_max: Float[Array, ""] | float
    range_min: Float[Array, ""] | float = 0.0
    mount: Mount = dataclasses.field(default_factory=Mount)
    echo: EchoParams = dataclasses.field(default_factory=EchoParams)
    shape: tuple[int, int] = struct.field(pytree_node=False, default=(1, 1))
    sweep: bool = struct.field(pytree_node=False, default=False)
    intensity: bool = struct.field(pytree_node=False, default=False)
    full_scale: float = struct.field(pytree_node=False, default=FULL_SCALE)
    texture: Float[Array, ""] | float | None = None
    doppler: bool = struct.field(pytree_node=False, default=False)

    @property
    def remembers(self) -> bool:
        return self.sweep or self.doppler

    @property
    def n_beams(self) -> int:
        """Beams of one image."""
        return self.shape[0] * self.shape[1]


SENSORS = ("planar16", "spin16x64", "vlp16", "os1-64", "avia")  # the first is the planar one


def make_sensor(sensor: Any, **changes: Any) -> SpatialParams:
    """Return a LiDAR in three dimensions by its name, or of one's own beams.

    Args:
        sensor: `spin16x64` (16 rings ± 15°, 64 azimuths, 30 m), `vlp16`, `os1-64`, `avia`; or unit vectors `(n, 3)` in
            the sensor's frame.
        **changes: Fields of `SpatialParams` in place of the sensor's own.

    Returns:
        Its params. `st.make(id, lidar=make_sensor("vlp16", mount=Mount(pitch=0.2)))` takes them.

    Raises:
        ValueError: There is no such sensor or field, or the beams are none.
    """
    if not isinstance(sensor, str):
        require_pattern(rays := np.asarray(sensor, np.float32))
        made = SpatialParams(jnp.asarray(rays), jnp.zeros(len(rays)), 30.0, shape=(1, len(rays)))
    elif sensor not in _MADE:
        raise ValueError(f"no sensor {sensor!r}; there are {', '.join(SENSORS)}, and unit vectors (n, 3)")
    else:
        made = _MADE[sensor]()
    known = {field.name for field in dataclasses.fields(SpatialParams)}
    if unknown := set(changes) - known:
        raise ValueError(f"a sensor has no {sorted(unknown)}; there are {sorted(known)}")
    return dataclasses.replace(made, **changes)


def _spinning(
    elevations: np.ndarray, n_columns: int, fired: float = 0.0, order: np.ndarray | None = None, **rest: Any
) -> SpatialParams:
    """Make a turning head that turns once in 0.1 s; `fired` s lie between its lasers, which fire in an order."""
    n_rings = len(elevations)
    columns = beams.spinning(elevations, n_columns).reshape(n_columns, n_rings, 3)
    turn = _TURN * (np.arange(n_columns) / n_columns - 1.0)
    within = fired * np.argsort(np.arange(n_rings) if order is None else order)
    return SpatialParams(
        directions=jnp.asarray(columns.swapaxes(0, 1).reshape(-1, 3)),
        times=jnp.asarray((turn[None] + within[:, None]).ravel(), jnp.float32),
        shape=(n_rings, n_columns),
        **rest,
    )


_TURN = 0.1  # s, of one sweep of every LiDAR here
_VLP16 = np.deg2rad(np.arange(-15.0, 16.0, 2.0))
# Source of the order and of the 2.304 µs between two lasers: VLP-16 user manual.
_VLP16_FIRED = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])


def _spin16x64() -> SpatialParams:
    """Return the sensor for learning: the rings of a VLP-16, every 28th azimuth."""
    return _spinning(_VLP16, 64, range_max=30.0)


def _vlp16() -> SpatialParams:
    """Return Velodyne's VLP-16: 100 m on a target of 50 %; least range and divergence are near the manual's."""
    errors = EchoParams(weakest=0.5 / 100.0**2, divergence=1.5e-3)
    return _spinning(
        _VLP16, 1800, 2.304e-6, _VLP16_FIRED, range_max=100.0, range_min=0.4, echo=errors, full_scale=100.0
    )


def _os1() -> SpatialParams:
    """Return Ouster's OS1-64: 45 m on a target of 10 %; ring 0 looks up."""
    errors = EchoParams(weakest=0.1 / 45.0**2, divergence=1.6e-3)
    rings = np.deg2rad(np.linspace(22.5, -22.5, 64))
    return _spinning(rings, 1024, range_max=120.0, range_min=0.5, echo=errors, full_scale=100.0)


def _avia() -> SpatialParams:
    """Return Livox's Avia: 190 m on a target of 10 %; one sweep of its rosette, the same in every scan."""
    n = 24_000
    errors = EchoParams(weakest=0.1 / 190.0**2, divergence=0.5 * np.deg2rad(np.sqrt(0.03 * 0.28)))
    return SpatialParams(
        directions=jnp.asarray(beams.rosette(n)),
        times=jnp.asarray(_TURN * (np.arange(n) / n - 1.0), jnp.float32),
        range_max=190.0,
        range_min=1.0,
        echo=errors,
        shape=(1, n),
    )


_MADE = {"spin16x64": _spin16x64, "vlp16": _vlp16, "os1-64": _os1, "avia": _avia}


@struct.dataclass
class Sweeping:
    """Pose at the beginning of the present sweep."""

    position: Float[Array, "2"]  # position, tunnel frame, m
    heading: Float[Array, ""]  # heading, rad


def along_arc(
    start: Sweeping, position: Float[Array, "2"], heading: Float[Array, ""], fraction: Float[Array, "n"]
) -> tuple[Float[Array, "n 2"], Float[Array, "n"]]:
    """Return poses (m, rad) at fractions of the way from one pose to another, by a constant speed and yaw rate."""
    turn = wrap(heading - start.heading)
    chord_x, chord_y = position[0] - start.position[0], position[1] - start.position[1]
    small = jnp.abs(turn) < 1e-3
    half = jnp.where(small, 1.0, 0.5 * turn)
    # A chord of the arc is as the sine of half its turn, and points half its turn past the first heading.
    size = jnp.where(small, fraction, jnp.sin(half * fraction) / jnp.sin(half))
    back = 0.5 * turn * (fraction - 1.0)
    cos, sin = size * jnp.cos(back), size * jnp.sin(back)
    x, y = cos * chord_x - sin * chord_y, sin * chord_x + cos * chord_y
    return start.position + jnp.stack([x, y], axis=-1), start.heading + fraction * turn


@dataclasses.dataclass(frozen=True)
class SpatialLidar(Part):
    """Ranges to the bore's whole surface as an image, with the errors of a real LiDAR.

    Its entry of the observation is `scan`: `SpatialParams.shape` row by row. Boxes of the part `obstacles` reach from
    floor to crown.
    """

    name: ClassVar[str] = "lidar"
    place: ClassVar[int] = 0

    def defaults(self) -> dict[str, Any]:
        return {"lidar": make_sensor("spin16x64")}

    def normals(self, params: EnvParams) -> int:
        return params.lidar.n_beams

    def uniforms(self, params: EnvParams) -> int:
        """As many for each beam as its errors take."""
        return params.lidar.n_beams * params.lidar.echo.n_uniform

    def begin(self, draw: Any, state: State, params: EnvParams) -> Any:
        """Stand still; nothing is kept without a sweep."""
        return Sweeping(state.position, state.heading) if params.lidar.remembers else ()

    def advance(self, own: Any, step: Step, noise: Noise, params: EnvParams) -> Any:
        return Sweeping(step.before.position, step.before.heading) if params.lidar.remembers else own

    def poses(
        self, own: Any, sensing: SensingState, params: EnvParams
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """Return origin (m) and direction of each beam, tunnel frame."""
        sensor = params.lidar
        if not sensor.sweep:
            place, axes = stand(sensing.tunnel, sensing.position, sensing.heading, sensing.station, sensor.mount)
            return jnp.broadcast_to(place, (sensor.n_beams, 3)), into_tunnel(axes, sensor.directions)
        fraction = 1.0 + sensor.times / jnp.asarray(params.vehicle.period)
        position, heading = along_arc(own, sensing.position, sensing.heading, fraction)
        tunnel = sensing.tunnel
        _, _, tangent_x, tangent_y, _ = at_station(tunnel, sensing.station)
        away = position - sensing.position
        station = sensing.station + away[:, 0] * tangent_x + away[:, 1] * tangent_y
        places, axes = jax.vmap(stand, (None, 0, 0, 0, None))(tunnel, position, heading, station, sensor.mount)
        turned = jax.vmap(lambda a, d: into_tunnel(a, d[None])[0])(axes, sensor.directions)
        return places, turned

    def relief(self, sensing: SensingState, params: EnvParams) -> Relief:
        return sensing.tunnel.space.relief

    def look(self, own: Any, sensing: SensingState, uniform: Any, params: EnvParams) -> tuple[Met, Array, Array, Array]:
        """Return the nearest surfaces, the cosines of incidence, the rays, and their origins.

        Args:
            uniform: Numbers for the sides of the rims; read where pixels are mixed.
        """
        sensor = params.lidar
        origins, rays = self.poses(own, sensing, params)
        n, both = sensor.n_beams, rays
        if sensor.echo.mixing:
            both = jnp.concatenate([rays, echo.rim_of(rays, uniform[:, 2], sensor.echo)])
            origins = jnp.concatenate([origins, origins]) if sensor.sweep else origins
        met = self._meet(origins, both, sensing, params)
        standing = sensing.hits(both[:, :2])
        nearer = standing < met.ranges
        met = met._replace(ranges=jnp.minimum(met.ranges, standing), thing=met.thing | nearer)
        normal = met.normal[:n]
        cosine = jnp.abs(jnp.sum(normal * rays, axis=-1))
        if sensor.echo.mixing:
            off = met.ranges[n:] * jnp.sum(normal * both[n:], axis=-1)
            off = off - met.ranges[:n] * jnp.sum(normal * rays, axis=-1)
            mixed = echo.mix(met.ranges[:n], met.ranges[n:], off, uniform[:, :2], sensor.echo)
            met = met._replace(ranges=jnp.where(met.ranges[:n] < sensor.range_max, mixed, met.ranges[:n]))
        return Met(met.ranges[:n], normal, met.thing[:n]), cosine, rays, origins[:n]

    def _meet(self, origins: Array, rays: Array, sensing: SensingState, params: EnvParams) -> Met:
        """Return what rays meet; those of one place as an image, which GPUs take tile by tile."""
        sensor, relief = params.lidar, self.relief(sensing, params)
        limit = jnp.asarray(sensor.range_max, jnp.float32)
        if sensor.sweep:
            return meet(relief, origins, rays, sensing.station, limit)
        image = meet(relief, origins[0], rays.reshape(-1, sensor.shape[1], 3), sensing.station, limit)
        return Met(*(part.reshape(len(rays), *part.shape[2:]) for part in image))

    def observe(self, own: Any, sensing: SensingState, noise: Noise, params: EnvParams) -> dict[str, Array]:
        """Return `scan`, m, and where asked `intensity`, 0 to 255, and `doppler`, m/s, row by row."""
        sensor, n = params.lidar, params.lidar.n_beams
        uniform = jnp.reshape(noise.uniform, (sensor.echo.n_uniform, n)).T if sensor.echo.n_uniform else None
        met, cosine, rays, origins = self.look(
            own, sensing, None if uniform is None else uniform[:, sensor.echo.losing :], params
        )
        ranges = sensing.corrupt(met.ranges)
        there = (ranges < sensor.range_max) & (ranges >= sensor.range_min)
        reflectivity = echo.albedo(met.normal[:, 2], met.thing, rays[:, 2] < 0.0)
        if sensor.texture is not None:
            ends = origins + met.ranges[:, None] * rays
            tunnel, (x, y, z) = sensing.tunnel, (ends[:, k] for k in range(3))
            node, ahead, left, at, *_ = place_ends(tunnel, sensing.station, sensing.position, x, y)
            ground = tunnel.space.ground[node]
            angle = wall_angle(jnp, left, z - ground[:, 0] - ground[:, 1] * ahead)
            factor = brightness(jnp, at, angle, tunnel.texture, sensor.texture)
            reflectivity = jnp.where(met.thing, reflectivity, reflectivity * factor)
        if uniform is not None and sensor.echo.losing:
            there &= echo.returns(ranges, cosine, reflectivity, uniform[:, 0], sensor.echo)
        noisy = echo.add_noise(ranges, cosine, noise.normal, sensor.echo)
        entries = {"scan": jnp.where(there, jnp.clip(noisy, 0.0, sensor.range_max), sensor.range_max)}
        if sensor.intensity:
            shown = intensity(cosine, reflectivity, normal_beside(noise.normal, 1), sensor.full_scale)
            entries["intensity"] = jnp.where(there, shown, 0.0)
        if sensor.doppler:
            closing = jnp.sum(rays * self._velocity(own, sensing, params), axis=-1)
            speeds = DOPPLER_SIGMA * normal_beside(noise.normal, 2) - closing
            entries["doppler"] = jnp.where(there, jnp.clip(speeds, -DOPPLER_MOST, DOPPLER_MOST), 0.0)
        return entries

    def _velocity(self, own: Sweeping, sensing: SensingState, params: EnvParams) -> Float[Array, "3"]:
        """Return the sensor's mean velocity over the last step, tunnel frame, m/s; 0 at the start."""
        mount, tunnel = params.lidar.mount, sensing.tunnel
        _, _, tangent_x, tangent_y, _ = at_station(tunnel, sensing.station)
        back = (own.position[0] - sensing.position[0]) * tangent_x + (own.position[1] - sensing.position[1]) * tangent_y
        before, _ = stand(tunnel, own.position, own.heading, sensing.station + back, mount)
        now, _ = stand(tunnel, sensing.position, sensing.heading, sensing.station, mount)
        return (now - before) / jnp.asarray(params.vehicle.period)

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        """Return bounds from 0 to the largest range, of intensities to 255, of speeds 20 m/s either way."""
        n, range_max = params.lidar.n_beams, jnp.max(jnp.asarray(params.lidar.range_max))
        entries: dict[str, Bounds] = {"scan": (np.zeros(n), jnp.full(n, range_max))}
        if params.lidar.intensity:
            entries["intensity"] = (np.zeros(n), np.full(n, MOST))
        if params.lidar.doppler:
            entries["doppler"] = (np.full(n, -DOPPLER_MOST), np.full(n, DOPPLER_MOST))
        return entries

    def images(self, params: EnvParams) -> dict[str, tuple[int, int]]:
        return {name: params.lidar.shape for name in self.space(params)}

    def check(self, others: frozenset[str], params: EnvParams) -> None:
        """Refuse a sweep whose moments other parts do not know, and a sensor inside the wall.

        Raises:
            ValueError: A part shows one instant alone.
            SubterraError: The sensor stands in the wall, the ground or a thing.
        """
        sensor = params.lidar
        if sensor.sweep and (late := others & {"obstacles", "faults"}):
            raise ValueError(
                f"sweep=True does not go with the part {min(late)!r}, which knows one instant of a scan alone"
            )
        numbers = [np.asarray(leaf) for leaf in jax.tree.leaves((sensor.mount, sensor.echo, sensor.range_max))]
        if not all(np.all(np.isfinite(number)) for number in numbers):
            raise ValueError("mount, echo and range_max of a sensor must be finite")
        if any(np.ndim(number) for number in numbers):
            return
        relief, station, place = _half_way(params.tunnel, sensor.mount)
        require_free(relief, np.asarray(place), float(station))


@jax.jit
def _half_way(tunnel: Any, mount: Mount) -> tuple[Relief, Float[Array, ""], Float[Array, "3"]]:
    """Return the surface of the first tunnel, the station half way through it, m, and where a sensor is there, m."""
    tunnel = tunnel.pick(0)
    station = 0.5 * tunnel.length
    x, y, tangent_x, tangent_y, _ = at_station(tunnel, station)
    place, _ = stand(tunnel, jnp.stack([x, y]), jnp.arctan2(tangent_y, tangent_x), station, mount)
    return tunnel.space.relief, station, place
