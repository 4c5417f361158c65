"""Films an episode: what the LiDAR sees, and where truth, odometer and agent have the robot.

`python -m benchmarks.draw film --agent locate-transformer --task StopAt --out out/film.webp`; a rover, with `--motion
rover`, and a B2, with `--task B2Traverse`, are seen from behind as well, in the scene of `--scene DIR`.
"""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle
from matplotlib.transforms import Affine2D
from PIL import Image

from benchmarks.command import BenchmarkError
from benchmarks.results import write_file
from subterra_jax import policies
from subterra_jax.host.files import require_file
from subterra_jax.host.task_ids import MISSIONS
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.pictures.camera import TunnelChoice
from subterra_jax.pictures.renderer import PictureError
from subterra_jax.recorder.config import open_place
from subterra_jax.recorder.trace import drive
from subterra_jax.tasks import TASKS, find
from subterra_jax.viewer.episode import Drawn, draw

_AHEAD, _ASIDE = 20.0, 4.5  # half sides of what the plan shows, m
_PICTURE = 80  # time of a picture on screen, ms
_LAST = 1500  # time of the last picture, ms
_FEW = 64  # beams that are drawn as lines; of more their ends are
_VIEW = (760, 340)  # pixels of the view from behind
View = Callable[[int], np.ndarray]
_WALL, _BEAM, _TRUTH, _ODOMETER, _AGENT = "#222222", "#e09f3e", "#1b4965", "#c1121f", "#2a9d8f"


@dataclass(frozen=True)
class FilmConfig:
    """Settings of the film.

    Example: python -m benchmarks.draw film --agent particle-filter --seed 3 --out out/film.webp
    """

    out: Path = Path("out/film.webp")  # File to write, .webp.
    task: str = "Subterra/StopAt-v1"  # Task.
    tunnel: str | None = None  # Tunnel: a name, a file, `open:SPLIT:INDEX`; the task's default if not given.
    agent: str = "locate-transformer"  # Who drives: a written agent, a released policy or a policy's file.
    motion: Literal["wheels", "rover"] = "wheels"  # What moves the robot; `rover`: physics, in MuJoCo's own engine.
    scene: Path | None = None  # Built scene folder in which the robot moves, in place of a tunnel.
    steps: int | None = None  # Steps at most; the task's horizon if not given.
    sensor: str = SENSORS[0]  # LiDAR.
    seed: int = 0  # Seed of the episode.
    pictures: int = 110  # Number of pictures.


def run(config: FilmConfig) -> None:
    """Drives an episode and writes its film.

    Raises:
        SubterraError: Agent, tunnel or file does not fit.
        ValueError: The task or the sensor does not exist, or a number is out of range.
    """
    if not 2 <= config.pictures <= 1000:
        raise BenchmarkError(f"pictures must be 2 to 1000, got {config.pictures}")
    require_file(config.out, ".webp")
    drawn, radius, view = drive_episode(config)
    name = "a trained policy" if Path(config.agent).exists() else config.agent
    write_file(
        config.out,
        film(drawn, radius, f"{find(config.task, short=True).split('/')[-1]}, driven by {name}", config.pictures, view),
    )
    print(f"{config.out}: {drawn.trace.time[-1]:.0f} s of driving, {drawn.trace.ended}")


def drive_episode(config: FilmConfig) -> tuple[Drawn, float, View | None]:
    """Drives the episode of the settings; returns it, the radius of the robot (m) and what draws a rover, or None."""
    id = find(config.task, short=True)
    world = open_place(id, config.tunnel, config.scene, None, config.sensor, config.motion)
    env, params = world.env, world.params
    agent = policies.open_agent(config.agent, env, params)
    drawn = draw(env, params, world.plan, drive(env, params, agent, config.seed, steps=config.steps))
    cut = TASKS[id].stretch if id in TASKS else None
    view = None if world.track is None else _view(config, env, params, drawn, cut)
    return drawn, float(params.vehicle.radius), view


def _view(config: FilmConfig, env: Any, params: Any, drawn: Drawn, stretch: Any) -> View | None:
    """Returns what draws a row of an episode from behind; None, with a word about it, where there is no OpenGL."""
    from subterra_jax.physics.stage import scene_file  # MuJoCo is loaded only where physics is meant
    from subterra_jax.physics.view import RobotView

    file = None if config.scene is None else scene_file(config.scene, None)
    choice = TunnelChoice(config.tunnel, stretch=stretch)
    engine = env.motion.walk.physics if env.id in MISSIONS else env.motion.engine
    camera = RobotView(engine, params.track, choice, file, *_VIEW)

    def view(row: int) -> np.ndarray:
        return camera.picture(env, params, jax.tree.map(lambda leaf: leaf[row], drawn.trace.state), np.zeros(0))

    try:
        view(0)
    except PictureError as error:
        print(f"without a view from behind: {error}")
        return None
    return view


def film(drawn: Drawn, radius: float, title: str, pictures: int, view: View | None = None) -> bytes:
    """Draws an episode as an animated WebP.

    Args:
        drawn: The episode.
        radius: Radius of the robot, m.
        title: What stands above it.
        pictures: Number of pictures, evenly spread in time.
        view: Draws the robot from behind above the plan; None for one without a body.
    """
    frames = [Image.fromarray(picture) for picture in _pictures(drawn, radius, title, pictures, view)]
    shown = [_PICTURE] * (len(frames) - 1) + [_LAST]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, "webp", save_all=True, append_images=frames[1:], duration=shown, loop=0, quality=60, method=4
    )
    return buffer.getvalue()


def _pictures(drawn: Drawn, radius: float, title: str, count: int, view: View | None) -> Iterator[np.ndarray]:
    heights, size = ((1.55, 1.0), 4.6) if view is None else ((3.6, 1.55, 1.0), 8.6)
    figure, (*above, plan, strip) = plt.subplots(
        len(heights), 1, figsize=(9.6, size), dpi=84, height_ratios=heights, layout="constrained"
    )
    figure.suptitle(title, fontsize=11)
    draw_plan, draw_strip = _plan(plan, drawn, radius), _strip(strip, drawn)
    behind = [axes.imshow(np.zeros((_VIEW[1], _VIEW[0], 3), np.uint8), aspect="equal") for axes in above]
    for axes in above:
        axes.axis("off")
    for row in np.unique(np.linspace(0, len(drawn) - 1, count).astype(int)):
        draw_plan(row)
        draw_strip(row)
        if view is not None:
            behind[0].set_data(view(row))
        figure.canvas.draw()
        figure.set_layout_engine("none")  # laying out again takes longer than drawing
        yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
    plt.close(figure)


def _plan(axes: Axes, drawn: Drawn, radius: float) -> Any:
    """Prepares the plan around the robot, the tunnel's direction to the right; returns what draws one row."""
    plan, station = drawn.centreline.plan, np.asarray(drawn.trace.state.station, np.float64)
    walls = LineCollection(list(wall_lines(drawn)), colors=_WALL, linewidths=1.3)
    axes.add_collection(walls)
    beams = LineCollection([], colors=_BEAM, linewidths=0.9, alpha=0.8)
    axes.add_collection(beams)
    (hits,) = axes.plot([], [], ".", color=_BEAM, ms=3.0)
    axes.add_patch(Circle((0.0, 0.0), radius, color=_TRUTH, zorder=5))
    (nose,) = axes.plot([], [], color=_TRUTH, lw=2.5, zorder=5)
    axes.set(xlim=(-_AHEAD, _AHEAD), ylim=(-_ASIDE, _ASIDE), aspect="equal", yticks=[], ylabel="plan")
    axes.set_xlabel("m from the robot")
    text = axes.text(0.99, 0.03, "", transform=axes.transAxes, ha="right", fontsize=9)
    goal = "" if np.isnan(drawn.goal) else f", goal {drawn.goal:.1f} m"

    def show(row: int) -> None:
        tangent = plan.tangent[np.searchsorted(plan.station, station[row]).clip(max=len(plan.station) - 1)]
        along = float(np.arctan2(tangent[1], tangent[0]))
        walls.set_transform(Affine2D().translate(*-drawn.truth[row, :2]).rotate(-along) + axes.transData)
        turn = Affine2D().rotate(float(drawn.heading[row]) - along)
        ends = turn.transform(drawn.hits[row, :, :2])
        beams.set_segments([np.stack([np.zeros(2), end]) for end in ends] if len(ends) <= _FEW else [])
        hits.set_data(*ends.T)
        front = turn.transform((2.0 * radius, 0.0))
        nose.set_data([0.0, front[0]], [0.0, front[1]])
        over = f": {drawn.trace.ended}" if row == len(drawn) - 1 else ""
        text.set_text(f"station {station[row]:.1f} m{goal}{over}")

    return show


def wall_lines(drawn: Drawn) -> list[Float[np.ndarray, "n 2"]]:
    """Returns the walls in the plane of the LiDAR as lines, tunnel frame, m, furniture and boxes too."""
    plan = drawn.centreline.plan
    lining = plan.lining(plan.default_lining)
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
    boxes = [box[:2] + (corner * box[4:]) @ np.array([box[2:4], [-box[3], box[2]]])
             for box in drawn.boxes.astype(np.float64)]  # fmt: skip
    return [lining.left.vertex, lining.right.vertex, *lining.furniture.reshape(-1, 2, 2), *boxes]


def _strip(axes: Axes, drawn: Drawn) -> Any:
    """Prepares the errors of odometer and agent over time; returns what draws one row."""
    agent = drawn.estimate[:, 0] - np.asarray(drawn.trace.state.station, np.float64)
    both = np.concatenate([drawn.odometer_error, agent[np.isfinite(agent)]])
    reach = max(1.15 * float(np.abs(both).max(initial=0.0)), 1.5)
    axes.axhline(0.0, color=_TRUTH, lw=1.5, label="truth")
    (by_odometer,) = axes.plot([], [], color=_ODOMETER, lw=1.8, label="odometer")
    (by_agent,) = axes.plot([], [], color=_AGENT, lw=1.8, label="agent's estimate")
    time = drawn.trace.time
    axes.set(xlim=(0.0, time[-1]), ylim=(-reach, reach), xlabel="s", ylabel="error of station, m")
    axes.legend(loc="upper left", ncols=3, fontsize=8, framealpha=0.9)
    axes.grid(alpha=0.3)

    def show(row: int) -> None:
        until = slice(0, row + 1)
        by_odometer.set_data(time[until], drawn.odometer_error[until])
        by_agent.set_data(time[until], agent[until])

    return show
