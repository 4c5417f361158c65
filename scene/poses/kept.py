"""Poses and cloud of a recording, kept beside the output while a build runs, so that a killed one goes on."""

import glob
import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scene.cloud import Cloud
from scene.inputs import input_files
from scene.poses.locate import Located
from scene.poses.place import Placed
from scene.poses.trajectory import Trajectory
from subterra_jax.host.files import replace_file
from subterra_jax.host.versions import VERSION

_ENDING = ".placed.npz"


def find_kept(out: Path, inputs: Iterable[Path], settings: Any) -> Path:
    """Return the file for the cloud of a build to `out`; its name changes with settings, or a file's time or size."""
    stats = [(str(file), file.stat()) for path in inputs for file in input_files(path.resolve())]
    facts = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    digest = hashlib.sha256(repr((VERSION, facts, settings)).encode()).hexdigest()
    return out.with_name(f".{out.name}-{digest[:16]}{_ENDING}")


def forget_kept(out: Path) -> None:
    """Removes whatever was kept for builds to `out`."""
    for path in out.parent.glob(f".{glob.escape(out.name)}-*{_ENDING}"):
        path.unlink()


def keep_placed(path: Path, placed: Placed) -> None:
    """Writes a registered cloud and its poses; raises `OutputError` where the disk refuses."""
    cloud, located = placed.cloud, placed.located
    assert located is not None  # of a recording
    poses = located.trajectory
    facts = {
        "record": placed.record, "facts": placed.facts, "located": located.facts, "estimated": located.estimated,
        "uncovered": located.most_uncovered, "source": poses.source, "returns": cloud.returns, "voxel": cloud.voxel,
    }  # fmt: skip
    intensity: dict[str, Any] = {} if cloud.intensity is None else {"intensity": cloud.intensity}
    with replace_file(path) as fresh, fresh.open("wb") as file:
        np.savez(
            file, facts=json.dumps(facts, default=lambda value: value.tolist()), points=cloud.points,
            weights=cloud.weights, origin=cloud.origin, low=placed.low, times=poses.times, positions=poses.positions,
            rotations=poses.rotations.as_quat(), **intensity,
        )  # fmt: skip


def load_kept(path: Path) -> Placed | None:
    """Return what `keep_placed` wrote, and say so; `None` where nothing is there."""
    if not path.is_file():
        return None
    with np.load(path) as data:
        facts = json.loads(str(data["facts"]))
        rotations = Rotation.from_quat(data["rotations"])
        poses = Trajectory(data["times"], data["positions"], rotations, facts["source"])
        intensity = data.get("intensity")
        cloud = Cloud(data["points"], data["weights"], data["origin"], facts["returns"], facts["voxel"], intensity)
        located = Located(poses, facts["located"], facts["estimated"], facts["uncovered"])
        low = data["low"]
    print(f"poses and cloud: those of a build that did not end ({path})", flush=True)
    return Placed(cloud, facts["record"], facts["facts"], located, low)
