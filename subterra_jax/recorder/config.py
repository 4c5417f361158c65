"""Settings of a recording, their checks, and the task, tunnel and agent that they name."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines.agent import Agent
from subterra_jax.evaluation import listed_episodes
from subterra_jax.host import rover
from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import require_folder
from subterra_jax.host.task_ids import MISSIONS
from subterra_jax.state import EnvParams
from subterra_jax.tasks import MOTIONS, TASKS, find, first_tunnel, is_planar
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import named
from subterra_jax.tunnel_env import TunnelEnv

SensorName = Literal["planar16", "spin16x64", "vlp16", "os1-64", "avia"]


class RecorderError(SubterraError):
    """A recording cannot be made with its settings."""


@dataclasses.dataclass(frozen=True)
class RecorderConfig:
    """Settings of one episode to record.

    Attributes:
        out: Folder to make; `recording/` and `truth/` go into it.
        task: Task id, as `Subterra/StopAt-v1` or `StopAt`.
        agent: Driver, as on the board: a baseline, `policy:NAME`, `policy:FILE`, `policy:RUN-FOLDER`,
            `module:Class` or `FILE.py:Class`.
        seed: Seed of everything random in the episode.
        episode: Record this one of the task's 500 listed episodes instead (from 0), as the board drives it.
        tunnel: Tunnel file or name; the first of those that the task has by itself if left out.
        scene: Scene folder of `scene.build` in its place, whose tunnel is driven; a rover drives on its ground.
        lining: Variant of the walls; `pockets` if left out.
        motion: `wheels`; or `rover`, by physics in MuJoCo's own engine, whose truth pitches and rolls.
        sensor: The robot's own LiDAR: `planar16`, or `spin16x64`, `vlp16`, `os1-64`, `avia` in three dimensions, whose
            returns are recorded as `/points` in place of `/scan`.
        every: Steps from one `/points` to the next.
        imu: Record an IMU at 100 Hz.
        steps: Steps after which the recording ends if the episode has not; the task's horizon if left out.
        truth: Folder for the truth, if it is to lie elsewhere.
    """

    out: Path
    task: str = "Subterra/StopAt-v1"
    agent: str = "dead-reckoning"
    seed: int = 0
    episode: int | None = None
    tunnel: str | None = None
    scene: Path | None = None
    lining: str | None = None
    motion: Literal["wheels", "rover"] = "wheels"
    sensor: SensorName = "planar16"
    every: int = 1
    imu: bool = False
    steps: int | None = None
    truth: Path | None = None

    @property
    def recording_folder(self) -> Path:
        """Folder of the sensors' part."""
        return self.out / "recording"

    @property
    def truth_folder(self) -> Path:
        """Folder of the truth."""
        return self.truth or self.out / "truth"


def check_config(config: RecorderConfig) -> RecorderConfig:
    """Check the numbers and folders of a config; return it unchanged.

    Raises:
        RecorderError: A number is out of range, two settings exclude each other, or a folder exists already.
        OutputError: A folder cannot be written.
    """
    least = {"every": 1, "seed": 0}
    if config.steps is not None:
        least["steps"] = 1
    if config.episode is not None:
        least["episode"] = 0
    for name, value in least.items():
        if getattr(config, name) < value:
            raise RecorderError(f"{name} must be at least {value}, got {getattr(config, name)}")
    if config.seed >= 2**32:
        raise RecorderError(f"seed must be below 2**32, got {config.seed}")
    for folder in (config.recording_folder, config.truth_folder):
        if folder.exists():
            raise RecorderError(f"{folder}: exists already; recordings are not overwritten")
        require_folder(folder)
    return config


@dataclasses.dataclass(frozen=True)
class World:
    """A task in a tunnel.

    Attributes:
        env: The environment.
        params: The task.
        plan: Stretch of tunnel of the task.
    """

    env: TunnelEnv
    params: EnvParams
    plan: TunnelPlan

    @property
    def is_spatial(self) -> bool:
        """True where the robot's LiDAR is one in three dimensions."""
        return "scan" in self.env.fields(self.params)

    @property
    def track(self) -> Any:
        """Ground of a robot by physics; None on the plan."""
        return None if self.env.motion.on_the_plan else self.params.track

    @property
    def sensor_height(self) -> float:
        """Height of LiDAR and IMU over the ground, m."""
        if not self.env.motion.on_the_plan:
            return rover.LIDAR_HEIGHT
        return float(self.params.lidar.mount.height) if self.is_spatial else self.plan.lidar_height


def open_world(config: RecorderConfig) -> World:
    """Make the task and read the tunnel of a recording.

    Raises:
        RecorderError: The task does not exist, or the tunnel is too short for it.
        TunnelError: The tunnel is missing or wrong.
    """
    name = find(config.task, short=True)
    if name not in TASKS:
        raise RecorderError(f"{name} cannot be recorded: the recorder drives robots on wheels")
    try:
        return open_place(name, config.tunnel, config.scene, config.lining, config.sensor, config.motion)
    except ValueError as error:
        raise RecorderError(str(error)) from error


def open_place(
    task: str, tunnel: str | None, scene: Path | None, lining: str | None, sensor: str, motion: str
) -> World:
    """Make a task for one robot: by MuJoCo's own engine, and on the ground of the scene, where it has mass.

    Args:
        task: The whole id.
        tunnel: Tunnel file or name; the first of those that the task has by itself if left out, with `scene` too.
        scene: Scene folder, in place of `tunnel`.
        lining: Variant of the walls; the tunnel's usual one if left out.
        sensor: Name of the LiDAR.
        motion: `wheels` or `rover`.

    Raises:
        SubterraError: A file is missing or wrong.
        ValueError: The tunnel is too short for the task, or an argument is out of range.
    """
    spatial = not is_planar(sensor)
    plan = st.load_tunnel(named(tunnel, scene) or first_tunnel(task, spatial), solid=spatial)
    by_physics = motion != MOTIONS[0] or task in MISSIONS
    physics: dict[str, Any] = {"engine": "mujoco", "scene": scene} if by_physics else {}
    if motion != MOTIONS[0]:
        physics["motion"] = motion
    given = plan if physics.get("scene") is None else None
    env, params = st.make(task, given, lining, sensor=sensor, **physics)
    return World(env, params, plan.stretch(TASKS[task].stretch if task in TASKS else None))


def open_agent(config: RecorderConfig, world: World) -> Agent:
    """Make the agent of a recording.

    Raises:
        SubterraError: The agent does not exist, or does not fit the task.
    """
    return policies.open_agent(config.agent, dataclasses.replace(world.env, estimates=True), world.params)


def draw_episode(config: RecorderConfig, world: World) -> tuple[int, int | None]:
    """Return seed and severity of the episode; without a severity the seed draws it.

    Raises:
        EvaluationError: The list does not have the episode.
    """
    if config.episode is None:
        return config.seed, None
    listed = listed_episodes(world.env, world.params, config.episode + 1)
    return int(listed.seed[-1]), int(listed.severity[-1])
