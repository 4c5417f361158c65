"""Sets of recorded episodes: the recordings to hand out, the truth to keep."""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from benchmarks.command import BenchmarkError
from benchmarks.results import write_file
from benchmarks.slam.reading import INDEX, RECORDINGS, TRUTH
from subterra_jax.evaluation.episodes import N_LISTED
from subterra_jax.host.task_ids import no_task
from subterra_jax.recorder import RecorderConfig, record
from subterra_jax.recorder.config import check_config, open_world
from subterra_jax.tasks import TASKS

SCHEMA = "subterra.recording-set/1"
# The oracle brings every episode to its end; on Relocalise it would not move, so the particle filter drives there.
_DRIVER, _SEEKER = "oracle", "particle-filter"
_WITHOUT_CLOUD = ("Obstructed", "Faulted")  # clouds show neither boxes nor faults


@dataclasses.dataclass(frozen=True)
class SetConfig:
    """Settings of a set of recordings."""

    out: Path  # Folder of the set: `recordings/` to hand out, `truth/` to keep.
    # Task ids, as `StopAt`.
    tasks: tuple[str, ...] = ("Traverse", "StopAt", "Return", "Obstructed", "Faulted", "Relocalise")
    linings: tuple[str, ...] = ("pockets",)  # Variants of the walls.
    episodes: int = 3  # Number of episodes of each task, from the start of its list.
    scene: Path | None = None  # Built scene folder; its tunnel is driven and clouds are recorded in it.
    tunnel: str | None = None  # Tunnel to use instead, without clouds.
    cloud: Literal["vlp16", "os1"] = "vlp16"  # 3-D LiDAR, if a scene is given and the task has no boxes or faults.
    columns: int = 900  # Columns of its sweep.
    beams: int = 720  # Beams of `/scan_dense`.
    steps: int | None = None  # Largest number of steps of a recording.
    # Number from which episodes are drawn instead of the public list, for a test whose truth nobody else can reproduce.
    # It is kept with the truth only.
    secret: int | None = None


def plan_set(config: SetConfig) -> list[tuple[str, RecorderConfig]]:
    """Returns the recordings of a set with their names, as `StopAt-pockets-000`.

    Raises:
        BenchmarkError: There is no such task, nothing to record, or a number is out of range.
    """
    if config.episodes < 1 or not config.tasks or not config.linings:
        raise BenchmarkError(f"nothing to record: {config.episodes} episodes of tasks {config.tasks}, {config.linings}")
    if config.episodes > N_LISTED and config.secret is None:
        raise BenchmarkError(f"episodes must be at most {N_LISTED}, the length of the list, got {config.episodes}")
    if config.secret is not None and config.secret < 0:
        raise BenchmarkError(f"secret must not be negative, got {config.secret}")
    plan = []
    for task in config.tasks:
        short = task.removeprefix("Subterra/").removesuffix("-v1")
        if f"Subterra/{short}-v1" not in TASKS:
            raise BenchmarkError(no_task(task, TASKS))
        for lining in config.linings:
            for episode in range(config.episodes):
                name = f"{short}-{lining}-{episode:03d}"
                plan.append((name, _recording(config, name, short, lining, episode)))
    return plan


def _recording(config: SetConfig, name: str, task: str, lining: str, episode: int) -> RecorderConfig:
    with_cloud = config.scene is not None and not task.startswith(_WITHOUT_CLOUD)
    one = RecorderConfig(
        out=config.out / RECORDINGS / name, truth=config.out / TRUTH / name, task=task, lining=lining,
        agent=_SEEKER if task.startswith("Relocalise") else _DRIVER, tunnel=config.tunnel, scene=config.scene,
        cloud=config.cloud if with_cloud else "none", columns=config.columns, beams=config.beams, imu=True,
        steps=config.steps,
    )  # fmt: skip
    if config.secret is None:
        return dataclasses.replace(one, episode=episode)
    return dataclasses.replace(one, seed=_secret_seed(config.secret, name))


def _secret_seed(secret: int, name: str) -> int:
    """Returns the seed of a recording's name; it cannot be computed without the secret."""
    return int.from_bytes(hashlib.sha256(f"{SCHEMA} {secret} {name}".encode()).digest()[:4], "little")


def make_set(config: SetConfig) -> Iterator[tuple[str, bool]]:
    """Records what is missing; yields each name and whether it was there already.

    Raises:
        BenchmarkError: The folder was recorded with other settings or cannot be written.
        SubterraError: A recording cannot be made.
    """
    plan = plan_set(config)
    for _, one in plan:
        if not one.recording_folder.is_dir():
            check_config(one)
    for one in {(one.task, one.lining): one for _, one in plan}.values():
        open_world(one)
    settings = {key: value for key, value in dataclasses.asdict(config).items() if key not in ("out", "tasks")}
    keep_settings(config.out, json.dumps({"schema": SCHEMA, "config": settings}, indent=1, default=str))
    for name, one in plan:
        exists = one.recording_folder.is_dir() and one.truth_folder.is_dir()
        if not exists:
            record(one)
        yield name, exists
    public = {key: value for key, value in settings.items() if key != "secret"}
    content = {"schema": SCHEMA, "recordings": [name for name, _ in plan], "config": public}
    (config.out / INDEX).write_text(json.dumps(content, indent=1, default=str) + "\n")


def keep_settings(folder: Path, settings: str) -> None:
    """Keeps the settings of a set with its truth.

    Raises:
        BenchmarkError: The set was recorded with others.
    """
    path = folder / TRUTH / INDEX
    if path.is_file() and path.read_text() != settings:
        raise BenchmarkError(f"{folder}: was recorded with other settings; choose another folder")
    write_file(path, settings.encode())
