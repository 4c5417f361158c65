"""A MuJoCo model of a stretch of tunnel, for pictures alone: nothing in it collides; and the wheeled robot in it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from subterra_jax.host.texture import brightness, wall_angle
from subterra_jax.pictures.surfaces import AROUND, Surface, tunnel_surfaces
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.shell import Shell

if TYPE_CHECKING:
    import mujoco

from typing import NamedTuple

BEHIND, AHEAD = 30.0, 70.0  # of the robot, m: the stretch that is drawn
_MARGIN = 20.0  # m from the end of a stretch at which the next one is made
_LAMP_SPACING, _BELOW_CROWN, _CROWN = 8.0, 0.5, 5.0  # m
_TILE, _PIXELS = 4.0, 512  # of a texture of noise: m, pixels
_PIXEL = 0.05  # m of the wall's own brightness
_DARK = 0.05  # grey of what lies beyond the fog


@dataclasses.dataclass(frozen=True)
class Stretch:
    """A stretch of a tunnel."""

    plan: TunnelPlan  # the tunnel
    lining: str | None  # variant of its walls
    start: float  # first station, m
    end: float  # last station, m
    texture: float = 0.0  # dial of the walls' brightness, 0 to 1

    @classmethod
    def around(cls, plan: TunnelPlan, lining: str | None, station: float, facing: float = 1.0) -> Stretch:
        """Return the stretch to draw for a robot at a station, m, that looks along (1) or against (-1) the axis."""
        before, after = (BEHIND, AHEAD) if facing > 0.0 else (AHEAD, BEHIND)
        return cls(plan, lining, max(station - before, 0.0), min(station + after, plan.length))

    def shows(self, station: float, facing: float = 1.0) -> bool:
        """Return whether a camera at a station, m, that looks along (1) or against (-1) the axis sees no end of it."""
        before, after = (_MARGIN, 2.0 * _MARGIN) if facing > 0.0 else (2.0 * _MARGIN, _MARGIN)
        enough = self.start <= 0.0 or station - self.start >= before
        return bool(enough and (self.end >= self.plan.length or self.end - station >= after))


def stage_spec(stretch: Stretch) -> mujoco.MjSpec:
    """Return the model of a stretch: its surfaces in the tunnel frame, lamps below the crown and fog.

    Raises:
        TunnelError: The plan does not have the lining.
    """
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "tunnel"
    _set_view(spec)
    _add_sky(spec, stretch)
    pixels, of_wall = _noise_picture(), (_TILE, _TILE)
    _add_picture(spec, "noise", pixels)
    if stretch.texture > 0.0 and stretch.plan.texture is not None and stretch.plan.shell is not None:
        pixels, of_wall = _wall_picture(stretch, stretch.plan.shell, stretch.plan.texture)
    _add_picture(spec, "wall", pixels)
    for surface in tunnel_surfaces(stretch.plan, stretch.lining, stretch.start, stretch.end):
        walled = surface.name == "wall"
        add_surface(spec, surface, *(("wall", of_wall) if walled else ()))
    for k, place in enumerate(_lamps(stretch)):
        spec.worldbody.add_light(
            name=f"lamp_{k}", pos=place, dir=(0.0, 0.0, -1.0), cutoff=180.0, exponent=0.0, castshadow=False,
            attenuation=(1.0, 0.05, 0.03), diffuse=(0.95, 0.91, 0.80), specular=(0.2, 0.2, 0.18), active=False,
        )  # fmt: skip
    return spec


def _add_picture(spec: mujoco.MjSpec, name: str, pixels: np.ndarray) -> None:
    import mujoco

    height, width, _ = pixels.shape
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3)
    texture.data = pixels.tobytes()


def add_surface(
    spec: mujoco.MjSpec, surface: Surface, picture: str = "noise", size: tuple[float, float] = (_TILE, _TILE)
) -> None:
    """Adds a surface to the world as a mesh that collides with nothing, with a picture of a size, m."""
    import mujoco

    points, faces = surface.triangles.vertices, surface.triangles.faces
    origin = np.floor(points.mean(axis=0))  # MuJoCo keeps meshes in single precision
    own = f"tunnel {surface.name}"
    mesh = spec.add_mesh(name=own, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.userface = (points - origin).ravel().tolist(), faces.ravel().tolist()
    textured = surface.rolled is not None
    if surface.rolled is not None:
        mesh.usertexcoord = (surface.rolled / size).ravel().tolist()
        mesh.userfacetexcoord = faces.ravel().tolist()
    material = spec.add_material(name=own, rgba=(*surface.colour, 1.0), specular=0.1, shininess=0.2)
    if textured:
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = picture
    spec.worldbody.add_geom(
        name=own, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=own, material=own, pos=origin, contype=0, conaffinity=0,
        group=1,
    )  # fmt: skip


def add_box(
    spec: mujoco.MjSpec, half: Any, position: Any, quaternion: Any, colour: tuple[float, ...], bits: int = 0
) -> None:
    """Adds a box to the world that collides with nothing but robots with these bits; half sizes and position in m."""
    import mujoco

    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=position, quat=quaternion, rgba=(*colour, 1.0)[:4], contype=bits,
        conaffinity=0, group=1,
    )  # fmt: skip


def _set_view(spec: mujoco.MjSpec) -> None:
    """Sets headlight, fog and clipping, as a built scene has them."""
    spec.stat.extent = 12.0
    visual = spec.visual
    visual.headlight.ambient, visual.headlight.diffuse = (0.30, 0.30, 0.31), (0.32, 0.32, 0.30)
    visual.headlight.specular = (0.0, 0.0, 0.0)
    visual.map.znear, visual.map.zfar = 0.005, 60.0
    visual.map.fogstart, visual.map.fogend = 1.5, 5.0
    visual.rgba.fog = (_DARK, _DARK, _DARK, 1.0)
    visual.quality.offsamples = 4


def _add_sky(spec: mujoco.MjSpec, stretch: Stretch) -> None:
    """Adds daylight at mouths, and darkness at other ends of the stretch."""
    import mujoco

    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.55, 0.70, 0.88), rgb2=(0.90, 0.93, 0.96), width=64, height=384,
    )  # fmt: skip
    plan = stretch.plan
    for station, mouth in ((stretch.start, 0.0), (stretch.end, plan.length)):
        if station == mouth:
            continue
        node = int(np.argmin(np.abs(plan.station - station)))
        heading = np.arctan2(plan.tangent[node, 1], plan.tangent[node, 0])
        turn = (np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading))
        add_box(spec, (0.05, 12.0, 15.0), (*plan.centre[node], plan.elevation[node]), turn, (_DARK, _DARK, _DARK))


def _lamps(stretch: Stretch) -> Float[np.ndarray, "k 3"]:
    """Return places below the crown, m; of an assumed height where the plan has no shell."""
    plan = stretch.plan
    station = np.arange(_LAMP_SPACING * np.ceil(stretch.start / _LAMP_SPACING) + 0.5 * _LAMP_SPACING, stretch.end, 8.0)
    if len(station) == 0:
        station = np.array([0.5 * (stretch.start + stretch.end)])
    if plan.shell is None:
        columns = np.column_stack([plan.centre, plan.elevation + _CROWN - _BELOW_CROWN]).T
        return np.stack([np.interp(station, plan.station, column) for column in columns], axis=-1)
    shell = plan.shell
    crown = shell.radius[:, int(np.argmin(np.abs(shell.angle - 0.5 * np.pi)))]
    columns = (shell.position + (crown - _BELOW_CROWN)[:, None] * shell.up).T
    return np.stack([np.interp(station + shell.window[0], shell.station, column) for column in columns], axis=-1)


def _wall_picture(stretch: Stretch, shell: Shell, seed: int) -> tuple[np.ndarray, tuple[float, float]]:
    """Return a picture of the brightness of the wall, `(around, along, 3)` uint8, and its size along and around.

    It is for walls unrolled as by `surfaces`; what is off the bore's usual section lies a little beside its place.
    """
    radius, own = np.median(shell.section), shell.window[0] + np.array([stretch.start - AROUND, stretch.end + AROUND])
    first = shell.station[shell.station >= own[0]][0] - shell.window[0]
    station = first + (np.arange(int(np.ptp(own) / _PIXEL)) + 0.5) * _PIXEL
    turn = (np.arange(int(2.0 * np.pi * radius / _PIXEL)) + 0.5) * _PIXEL / radius
    reach = np.interp(turn, shell.angle, shell.section, period=2.0 * np.pi)
    ground = np.interp(station, stretch.plan.station, stretch.plan.elevation)
    height = np.median(np.interp(station + shell.window[0], shell.station, shell.position[:, 2]) - ground)
    angle = wall_angle(np, reach * np.cos(turn), reach * np.sin(turn) + height)
    shade = np.clip(0.8 * brightness(np, station[None], angle[:, None], seed, stretch.texture), 0.0, 1.0)
    pixels = np.repeat((255.0 * shade).astype(np.uint8)[..., None], 3, axis=2)
    return pixels, (len(station) * _PIXEL, 2.0 * np.pi * radius)


def _noise_picture() -> np.ndarray:
    """Return a grey picture of stains that repeats at its edges, `(n, n, 3)` uint8."""
    shade = np.full((_PIXELS, _PIXELS), 0.86)
    for fraction, size, seed in ((0.03, 1.5, 0), (0.05, 12.0, 1), (0.05, 45.0, 2)):
        white = np.fft.rfft2(np.random.default_rng(seed).standard_normal(shade.shape))
        v, u = np.fft.fftfreq(_PIXELS)[:, None] * size, np.fft.rfftfreq(_PIXELS)[None, :] * size
        field = np.fft.irfft2(white * np.exp(-2.0 * np.pi**2 * (v**2 + u**2)), shade.shape)
        shade += fraction * field / field.std()
    return np.repeat(np.clip(255.0 * shade, 0.0, 255.0).astype(np.uint8)[..., None], 3, axis=2)


_HULL, _WHEEL, _MAST, _SENSOR = (226, 106, 24), (38, 38, 42), (92, 94, 100), (30, 34, 40)
_WHEEL_RADIUS = 0.4  # of the robot's radius


class Part(NamedTuple):
    """One box or cylinder of the robot, in its frame: x ahead, y to the left, z up from the ground.

    Attributes:
        kind: `box` or `cylinder`.
        half: Half sizes of a box; radius and half length of a cylinder, m.
        middle: Middle, m.
        colour: Red, green, blue, 0 to 255.
        across: Turned so that a cylinder's axis points to the left; else it points upwards.
    """

    kind: str
    half: tuple[float, ...]
    middle: tuple[float, float, float]
    colour: tuple[int, int, int]
    across: bool = False


def carrier_parts(radius: float, lidar_height: float) -> list[Part]:
    """Return the parts of a robot that stands on z = 0 and faces x.

    Args:
        radius: Radius of its footprint, m.
        lidar_height: Height of its LiDAR, m.
    """
    deck = 0.95 * radius
    top = max(lidar_height, deck + 0.2)
    wheel = (_WHEEL_RADIUS * radius, 0.125 * radius)
    return [
        Part("box", (0.75 * radius, 0.475 * radius, 0.225 * radius), (0.0, 0.0, 0.75 * radius), _HULL),
        Part("box", (0.125 * radius, 0.3 * radius, 0.1 * radius), (0.8 * radius, 0.0, deck), _SENSOR),
        Part("cylinder", (0.06 * radius, 0.5 * (top - deck)), (0.0, 0.0, 0.5 * (top + deck)), _MAST),
        Part("cylinder", (0.22 * radius, 0.05), (0.0, 0.0, top), _SENSOR),
        *(
            Part("cylinder", wheel, (x * radius, y * radius, wheel[0]), _WHEEL, across=True)
            for x in (-0.5, 0.5)
            for y in (-0.6, 0.6)
        ),
    ]


def add_carrier(
    scene: Any, ground: Float[np.ndarray, 3], heading: float, pitch: float, radius: float, lidar_height: float
) -> None:
    """Add the robot to an abstract MuJoCo scene that is about to be drawn.

    Args:
        scene: `mujoco.MjvScene`, after `update_scene`.
        ground: Point below the robot's middle, m.
        heading: Heading in plan, rad.
        pitch: Slope of the ground ahead, rad; positive rises.
        radius: Radius of the footprint, m.
        lidar_height: Height of the LiDAR, m.
    """
    import mujoco

    cos, sin, level, rise = np.cos(heading), np.sin(heading), np.cos(pitch), np.sin(pitch)
    ahead, left = np.array([level * cos, level * sin, rise]), np.array([-sin, cos, 0.0])
    axes = np.stack([ahead, left, np.cross(ahead, left)], axis=-1)
    kinds = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}
    for part in carrier_parts(radius, lidar_height):
        turn = axes[:, [2, 0, 1]] if part.across else axes
        half = (*part.half, 0.0)[:3]
        colour = np.array([*part.colour, 255], np.float32) / np.float32(255)
        middle = ground + axes @ np.array(part.middle)
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kinds[part.kind], np.array(half), middle, turn.ravel(), colour)
        scene.ngeom += 1
