"""Films an episode: what the LiDAR sees, and where truth, odometer and agent have the robot.

`python -m benchmarks.draw film --agent locate-transformer --task StopAt-v1 --out out/film.webp`
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle
from matplotlib.transforms import Affine2D
from PIL import Image
from subterra_jax.viewer.driving import drive
from subterra_jax.viewer.recording import Recording

import subterra_jax as st
from benchmarks.command import BenchmarkError, run_main
from benchmarks.results import write_file
from subterra_jax import policies
from subterra_jax.host.files import require_file
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.state import EnvParams
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel_env import TunnelEnv

_AHEAD, _ASIDE = 20.0, 4.5  # half sides of what the plan shows, m
_PICTURE = 80  # time of a picture on screen, ms
_LAST = 1500  # time of the last picture, ms
_WALL, _BEAM, _TRUTH, _ODOMETER, _AGENT, _GOAL = "#222222", "#e09f3e", "#1b4965", "#c1121f", "#2a9d8f", "#8d99ae"


@dataclass(frozen=True)
class FilmConfig:
    """Settings of the film.

    Example: python -m benchmarks.draw film --agent particle-filter --seed 3 --out out/film.webp
    """

    out: Path = Path("out/film.webp")  # File to write, .webp.
    task: str = "Subterra/StopAt-v1"  # Task.
    tunnel: str | None = None  # Tunnel: a name, a file, `open:SPLIT:INDEX`; the task's default if not given.
    agent: str = "locate-transformer"  # Who drives: a written agent, a released policy or a policy's file.
    sensor: str = SENSORS[0]  # LiDAR.
    seed: int = 0  # Seed of the episode.
    pictures: int = 110  # Number of pictures.


def main(words: list[str] | None = None) -> int:
    """Runs the command."""
    return run_main("draw film", FilmConfig, run, words=words)


def run(config: FilmConfig) -> None:
    """Drives an episode and writes its film.

    Raises:
        SubterraError: Agent, tunnel or file does not fit.
        ValueError: The task or the sensor does not exist, or a number is out of range.
    """
    if not 2 <= config.pictures <= 1000:
        raise BenchmarkError(f"pictures must be 2 to 1000, got {config.pictures}")
    require_file(config.out, ".webp")
    env, params = st.make(config.task, tunnel=config.tunnel, sensor=config.sensor)
    agent = policies.open_agent(config.agent, env, params)
    name = "a trained policy" if Path(config.agent).exists() else config.agent
    recording = drive_whole(env, params, agent, config.seed, str(config.tunnel or ""), name)
    write_file(config.out, film(params, recording, config.pictures))
    outcome = "success" if recording.success else "contact" if recording.contact else "no success"
    print(f"{config.out}: {recording.duration:.0f} s of driving, {outcome}")


def drive_whole(env: TunnelEnv, params: EnvParams, agent: Any, seed: int, tunnel: str, name: str) -> Recording:
    """Drives an episode to its end."""
    *_, recording = drive(
        env, params, agent, seed, {"tunnel": tunnel, "tunnel_sha256": "", "lining": "", "agent": name}
    )
    return recording


def film(params: EnvParams, recording: Recording, pictures: int) -> bytes:
    """Draws an episode as an animated WebP.

    Args:
        params: The task in its tunnel.
        recording: The episode.
        pictures: Number of pictures, evenly spread in time.
    """
    frames = [Image.fromarray(picture) for picture in _pictures(params, recording, pictures)]
    shown = [_PICTURE] * (len(frames) - 1) + [_LAST]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, "webp", save_all=True, append_images=frames[1:], duration=shown, loop=0, quality=60, method=4
    )
    return buffer.getvalue()


def _pictures(params: EnvParams, recording: Recording, count: int) -> Iterator[np.ndarray]:
    figure, (plan, strip) = plt.subplots(
        2, 1, figsize=(9.6, 4.6), dpi=84, height_ratios=(1.55, 1.0), layout="constrained"
    )
    figure.suptitle(f"{recording.task.split('/')[-1]}, driven by {recording.agent}", fontsize=11)
    draw_plan, draw_strip = _plan(plan, params, recording), _strip(strip, recording)
    for row in np.unique(np.linspace(0, len(recording) - 1, count).astype(int)):
        draw_plan(row)
        draw_strip(row)
        figure.canvas.draw()
        yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
    plt.close(figure)


def _plan(axes: Axes, params: EnvParams, recording: Recording) -> Any:
    """Prepares the plan around the robot, the tunnel's direction to the right; returns what draws one row."""
    tunnel = params.tunnel
    walls = LineCollection(list(wall_segments(tunnel)), colors=_WALL, linewidths=1.3)
    axes.add_collection(walls)
    beams = LineCollection([], colors=_BEAM, linewidths=0.9, alpha=0.8)
    axes.add_collection(beams)
    (hits,) = axes.plot([], [], ".", color=_BEAM, ms=3.0)
    axes.add_patch(Circle((0.0, 0.0), recording.radius, color=_TRUTH, zorder=5))
    (nose,) = axes.plot([], [], color=_TRUTH, lw=2.5, zorder=5)
    axes.set(xlim=(-_AHEAD, _AHEAD), ylim=(-_ASIDE, _ASIDE), aspect="equal", yticks=[], ylabel="plan")
    axes.set_xlabel("m from the robot")
    text = axes.text(0.99, 0.03, "", transform=axes.transAxes, ha="right", fontsize=9)
    goal = "" if np.isnan(recording.goal) else f", goal {recording.goal:.1f} m"
    end = "success" if recording.success else "contact" if recording.contact else "no success"
    grid, spacing = np.asarray(tunnel.grid, np.float64), float(tunnel.spacing)

    def draw(row: int) -> None:
        node = int(np.clip(round(float(recording.station[row]) / spacing), 0, len(grid) - 1))
        along = float(np.arctan2(grid[node, 3], grid[node, 2]))
        walls.set_transform(
            Affine2D().translate(*-recording.position[row].astype(float)).rotate(-along) + axes.transData
        )
        ends = tips(recording, row) @ _rotation(float(recording.heading[row]) - along).T
        planar = not recording.points.shape[1]
        beams.set_segments([np.stack([np.zeros(2), end]) for end in ends] if planar else [])
        hits.set_data(*ends.T)
        front = _rotation(float(recording.heading[row]) - along) @ np.array([2.0 * recording.radius, 0.0])
        nose.set_data([0.0, front[0]], [0.0, front[1]])
        over = f": {end}" if row == len(recording) - 1 else ""
        text.set_text(f"station {recording.station[row]:.1f} m{goal}{over}")

    return draw


def wall_segments(tunnel: Tunnel) -> Float[np.ndarray, "n 2 2"]:
    """Returns start and end of all segments of the walls, tunnel frame, m."""
    vertex = np.asarray(tunnel.box[:2]).T[:, :, None] + np.asarray(tunnel.wall)  # (blocks, 2, k)
    return np.stack([vertex[:, :, :-1], vertex[:, :, 1:]], axis=-1).transpose(0, 2, 3, 1).reshape(-1, 2, 2)


def tips(recording: Recording, row: int) -> Float[np.ndarray, "n 2"]:
    """Returns the ends of the beams in the robot's frame, m; of a LiDAR in three dimensions its returns."""
    if recording.points.shape[1]:
        return recording.points[row, :, :2]
    ranges = recording.ranges[row]
    angle = np.arange(len(ranges)) * (2.0 * np.pi / len(ranges))
    return ranges[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _strip(axes: Axes, recording: Recording) -> Any:
    """Prepares the errors of odometer and agent along the way; returns what draws one row."""
    odometer = recording.start + recording.odometry[:, 0] - recording.station
    agent = recording.estimate[:, 0] - recording.station
    time = np.arange(len(recording)) * recording.period
    both = np.concatenate([odometer, agent[np.isfinite(agent)]])
    reach = max(1.15 * float(np.abs(both).max(initial=0.0)), 1.5)
    axes.axhline(0.0, color=_TRUTH, lw=1.5, label="truth")
    (by_odometer,) = axes.plot([], [], color=_ODOMETER, lw=1.8, label="odometer")
    (by_agent,) = axes.plot([], [], color=_AGENT, lw=1.8, label="agent's estimate")
    axes.set(xlim=(0.0, time[-1]), ylim=(-reach, reach), xlabel="s", ylabel="error of station, m")
    axes.legend(loc="upper left", ncols=3, fontsize=8, framealpha=0.9)
    axes.grid(alpha=0.3)

    def draw(row: int) -> None:
        until = slice(0, row + 1)
        by_odometer.set_data(time[until], odometer[until])
        by_agent.set_data(time[until], agent[until])

    return draw
