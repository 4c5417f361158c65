"""Pictures of bores in three dimensions for `benchmarks.linings`: a tunnel rolled out flat, and kinds rendered."""

import io
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image, ImageDraw

from benchmarks.command import BenchmarkError
from subterra_jax.pictures.renderer import import_mujoco, light_near, open_renderer
from subterra_jax.pictures.stage import Piece, stage_spec
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.shell import Shell

_INK, _PLANE, _POCKET = "#222222", "#c1121f", "#1b4965"
_SIZE = (400, 280)  # pixels of one rendered bore
_COLUMNS = 3
_EYE, _AHEAD, _SHOWN = 12.0, 5.0, 60.0  # m: station of the camera, where it looks, and length that is drawn
_OF_SECTION = -0.1  # height of the camera above the axis, m
_FOV = 80.0  # degrees, upright
_QUALITY = 60


def unrolled_picture(plan: TunnelPlan, lining: str, length: float) -> Figure:
    """Draws the first metres of a tunnel: the wall with its recesses rolled out flat, and the plan.

    Raises:
        BenchmarkError: The tunnel has no bore in three dimensions.
    """
    if plan.shell is None:
        raise BenchmarkError(f"tunnel {plan.name!r} has no bore in three dimensions to roll out")
    figure, (above, below) = plt.subplots(2, 1, figsize=(11.0, 5.0), height_ratios=(1.6, 1.0), layout="constrained")
    _draw_wall(above, plan, plan.shell, lining, length)
    _draw_plan(below, plan, lining, length)
    figure.suptitle(f"{plan.name}, {lining}", fontsize=11)
    return figure


def _draw_wall(axes: Axes, plan: TunnelPlan, shell: Shell, lining: str, length: float) -> None:
    seam = shell.linings[lining].seam
    order = np.argsort(np.mod(shell.angle - seam, 2.0 * np.pi))
    angle = np.mod(shell.angle[order] - seam, 2.0 * np.pi) + seam
    outline = shell.section[order, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    girth = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    rows = shell.station <= length
    off = 1e3 * (shell.radius[rows][:, order] - shell.section[order]).T
    most = max(1.0, float(np.quantile(np.abs(off), 0.995)))
    image = axes.pcolormesh(
        shell.station[rows], girth, off, cmap="RdBu_r", vmin=-most, vmax=most, shading="nearest", rasterized=True
    )
    axes.figure.colorbar(image, ax=axes, label="wall outside the mean section, mm", pad=0.01)

    def around(at: np.ndarray) -> np.ndarray:
        return np.interp(np.mod(at - seam, 2.0 * np.pi) + seam, angle, girth)

    pocket = shell.linings[lining].pocket
    pocket = pocket[pocket[:, 0] < length]
    for (at, _, along, wide, _), place in zip(pocket, around(pocket[:, 1]), strict=True):
        corner = (at - 0.5 * along, place - 0.5 * wide)
        axes.add_patch(Rectangle(corner, along, wide, fill=False, ec=_POCKET, lw=0.7))
    for met in plane_angles(plan, shell):
        axes.plot(shell.station[rows], around(met[rows]), color=_PLANE, lw=0.9)
    axes.set(ylabel="around the section, m", xlim=(0.0, length))
    axes.set_xlabel("station, m (red: where the LiDAR's plane meets the wall)")


def plane_angles(plan: TunnelPlan, shell: Shell) -> list[Float[np.ndarray, " n"]]:
    """Return the angles at which a level plane at the LiDAR's height meets the left and the right wall, rad."""
    height = np.interp(shell.station, plan.station, plan.elevation) + plan.lidar_height - shell.position[:, 2]
    up = shell.radius * np.sin(shell.angle) * shell.up[:, 2:]
    sides = []
    for side in (1.0, -1.0):
        columns = np.flatnonzero(side * np.cos(shell.angle) > 0.1)
        lift = np.arcsin(np.sin(shell.angle[columns]))
        columns = columns[np.argsort(lift)]
        rise = np.sort(lift)
        met = np.array([np.interp(h, u, rise) for h, u in zip(height, up[:, columns], strict=True)])
        sides.append(met if side > 0.0 else np.pi - met)
    return sides


def _draw_plan(axes: Axes, plan: TunnelPlan, lining: str, length: float) -> None:
    walls = plan.lining(lining)
    for wall, side in ((walls.left, 1.0), (walls.right, -1.0)):
        x, y, tangent_x, tangent_y = (
            np.interp(wall.station, plan.station, column) for column in (*plan.centre.T, *plan.tangent.T)
        )
        lateral = tangent_x * (wall.vertex[:, 1] - y) - tangent_y * (wall.vertex[:, 0] - x)
        axes.plot(wall.station, lateral, color=_INK, lw=0.8)
        axes.fill_between(wall.station, lateral, side * (np.abs(lateral).max() + 0.4), color="#dddddd", lw=0)
    axes.axhline(0.0, color="#999999", lw=0.6, ls=":")
    axes.set(ylabel="left of the axis, m", xlim=(0.0, length))
    axes.set_xlabel("station, m (the plan: walls in the LiDAR's plane)")


def contact_sheet(plans: Sequence[tuple[str, TunnelPlan]]) -> bytes:
    """Renders each tunnel as a camera on its axis sees it; returns one WebP with all of them and their titles.

    Raises:
        SubterraError: MuJoCo cannot draw here.
    """
    wide, high = _SIZE
    rows = -(-len(plans) // _COLUMNS)
    sheet = Image.new("RGB", (wide * _COLUMNS, high * rows))
    for k, (title, plan) in enumerate(plans):
        picture = Image.fromarray(render_bore(plan))
        ImageDraw.Draw(picture).text((8, high - 18), title, fill=(255, 255, 255), stroke_width=2, stroke_fill=(0, 0, 0))
        sheet.paste(picture, (wide * (k % _COLUMNS), high * (k // _COLUMNS)))
    out = io.BytesIO()
    sheet.save(out, format="webp", quality=_QUALITY)
    return out.getvalue()


def render_bore(plan: TunnelPlan) -> np.ndarray:
    """Renders the view down a bore, `(height, width, 3)` uint8."""
    mujoco = import_mujoco("rendering linings")
    shell = plan.shell
    if shell is None:
        raise BenchmarkError(f"tunnel {plan.name!r} has no bore in three dimensions to render")
    row, target = (int(np.searchsorted(shell.station, station)) for station in (_EYE, _EYE + _AHEAD))
    eye = shell.position[row] + _OF_SECTION * shell.up[row]
    ahead = shell.position[target] - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    spec = stage_spec(Piece(plan, plan.default_lining, 0.0, min(_SHOWN, plan.length)))
    turn = np.empty(4)
    mujoco.mju_mat2Quat(turn, np.column_stack([right, np.cross(right, ahead), -ahead]).ravel())
    spec.worldbody.add_camera(name="eye", pos=eye, quat=turn, fovy=_FOV)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    light_near(model, data, eye + _AHEAD * ahead)
    with open_renderer(model, *_SIZE) as renderer:
        renderer.update_scene(data, camera="eye")
        return np.asarray(renderer.render())
