"""Sets of evaluation recordings: for each task its first listed episodes, what was recorded apart from the truth."""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from benchmarks.slam.errors import SlamError
from subterra_jax.evaluation.episodes import N_LISTED
from subterra_jax.recorder import Recording, record
from subterra_jax.recorder.config import checked
from subterra_jax.recorder.world import open_world
from subterra_jax.tasks import TASKS
from subterra_jax.versions import no_task

SCHEMA = "subterra.recording-set/1"
RECORDINGS, TRUTH, INDEX = "recordings", "truth", "set.json"
# An agent that knows the truth brings every episode to its end; where it need not move, one that drives to find out.
_DRIVER, _SEEKER = "oracle", "particle-filter"
_UNSEEN = ("Obstructed", "Faulted")  # what clouds do not show: boxes, faults


@dataclasses.dataclass(frozen=True)
class SetConfig:
    """What to record.

    Attributes:
        out: Folder of the set: `recordings/` to hand out, `truth/` to keep.
        tasks: Ids of tasks, as `StopAt`.
        linings: Variants of the walls.
        episodes: Episodes of each task, the first of its list.
        scene: Built scene folder, whose tunnel is driven and in which clouds are taken.
        tunnel: Tunnel instead, without clouds.
        cloud: LiDAR in three dimensions, where a scene is given and the task has nothing that it would not see.
        columns: Its columns.
        beams: Beams of `/scan_dense`.
        steps: Steps at most of each recording.
        secret: A number that episodes are drawn from instead of the list, for a test whose truth nobody can make
            again who does not know it: the list is public. It is kept with the truth alone.
    """

    out: Path
    tasks: tuple[str, ...] = ("Traverse", "StopAt", "Return", "Obstructed", "Faulted", "Relocalise")
    linings: tuple[str, ...] = ("pockets",)
    episodes: int = 3
    scene: Path | None = None
    tunnel: str | None = None
    cloud: Literal["vlp16", "os1"] = "vlp16"
    columns: int = 900
    beams: int = 720
    steps: int | None = None
    secret: int | None = None


def planned(config: SetConfig) -> list[tuple[str, Recording]]:
    """The recordings of a set by name: `StopAt-pockets-000`.

    Raises:
        SlamError: There is no such task, nothing to record, or a number is out of range.
    """
    if config.episodes < 1 or not config.tasks or not config.linings:
        raise SlamError(f"nothing to record: {config.episodes} episodes of tasks {config.tasks}, {config.linings}")
    if config.episodes > N_LISTED and config.secret is None:
        raise SlamError(f"episodes must be at most {N_LISTED}, which is what the list has, got {config.episodes}")
    if config.secret is not None and config.secret < 0:
        raise SlamError(f"secret must not be negative, got {config.secret}")
    found = []
    for task in config.tasks:
        short = task.removeprefix("Subterra/").removesuffix("-v0")
        if f"Subterra/{short}-v0" not in TASKS:
            raise SlamError(no_task(task, TASKS))
        for lining in config.linings:
            for episode in range(config.episodes):
                name = f"{short}-{lining}-{episode:03d}"
                found.append((name, _recording(config, name, short, lining, episode)))
    return found


def _recording(config: SetConfig, name: str, task: str, lining: str, episode: int) -> Recording:
    sees = config.scene is not None and not task.startswith(_UNSEEN)
    one = Recording(
        out=config.out / RECORDINGS / name, truth=config.out / TRUTH / name, task=task, lining=lining,
        agent=_SEEKER if task.startswith("Relocalise") else _DRIVER, tunnel=config.tunnel, scene=config.scene,
        cloud=config.cloud if sees else "none", columns=config.columns, beams=config.beams, imu=True,
        steps=config.steps,
    )  # fmt: skip
    if config.secret is None:
        return dataclasses.replace(one, episode=episode)
    return dataclasses.replace(one, seed=_drawn(config.secret, name))


def _drawn(secret: int, name: str) -> int:
    """The seed that belongs to a recording's name; it cannot be computed without the secret."""
    return int.from_bytes(hashlib.sha256(f"{SCHEMA} {secret} {name}".encode()).digest()[:4], "little")


def make_set(config: SetConfig) -> Iterator[tuple[str, bool]]:
    """Record what is not there yet; name by name, and whether it had been there.

    Raises:
        SlamError: What is there was recorded with other settings, or the folder cannot be written.
        SubterraError: A recording cannot be made.
    """
    plan = planned(config)
    _check(plan)
    settings = {key: value for key, value in dataclasses.asdict(config).items() if key not in ("out", "tasks")}
    _settle(config.out / TRUTH / INDEX, json.dumps({"schema": SCHEMA, "config": settings}, indent=1, default=str))
    for name, one in plan:
        there = one.recording_folder.is_dir() and one.truth_folder.is_dir()
        if not there:
            record(one)
        yield name, there
    told = {key: value for key, value in settings.items() if key != "secret"}
    content = {"schema": SCHEMA, "recordings": [name for name, _ in plan], "config": told}
    (config.out / INDEX).write_text(json.dumps(content, indent=1, default=str) + "\n")


def _check(plan: list[tuple[str, Recording]]) -> None:
    """Refuses a set before anything of it is written: its numbers and folders, and each task once with each lining."""
    for _, one in plan:
        if not one.recording_folder.is_dir():
            checked(one)
    for one in {(one.task, one.lining): one for _, one in plan}.values():
        open_world(one)


def _settle(path: Path, settings: str) -> None:
    """Keeps the settings of a set, with the truth, and refuses others later."""
    try:
        if path.is_file() and path.read_text() != settings:
            raise SlamError(f"{path.parent.parent}: was recorded with other settings; choose another folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(settings)
    except OSError as error:
        raise SlamError(f"{path}: cannot be written ({error.strerror})") from error


def recordings_in(folder: Path) -> list[tuple[str, Path]]:
    """Names and bags of the recordings in a folder; of a set, or of its `recordings/`.

    Raises:
        SlamError: There are none.
    """
    inside = folder / RECORDINGS if (folder / RECORDINGS).is_dir() else folder
    found = sorted(path.parent for path in inside.glob("*/recording/metadata.yaml")) if inside.is_dir() else []
    if not found:
        raise SlamError(f"{folder}: holds no recordings (`python -m benchmarks.slam record` makes some)")
    return [(bag.parent.name, bag) for bag in found]
