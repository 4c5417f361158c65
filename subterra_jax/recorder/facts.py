"""What a recording and its truth say of themselves, in JSON."""

import hashlib
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from subterra_jax.evaluation.episodes import SHA256
from subterra_jax.recorder import messages, poses, sensing
from subterra_jax.recorder.config import Recording
from subterra_jax.recorder.drive import Trace
from subterra_jax.recorder.world import World

RECORDING, TRUTH = "subterra.recording/1", "subterra.recording-truth/1"
_LIBRARIES = ("subterra-jax", "jax", "numpy", "rosbags")


def recording(config: Recording, trace: Trace, world: World, topics: dict[str, Any]) -> dict[str, Any]:
    """What may be known without knowing the truth: neither seed nor outcome."""
    env, params, plan = world.env, world.params, world.plan
    parts = {name: where for name, where in env.fields(params).items() if name not in ("ranges", "odometry")}
    first = {name: float(trace.observation[0, where][0]) for name, where in parts.items() if name != "flag"}
    sensors: dict[str, Any] = {"lidar_height": plan.lidar_height, "scan_beams": params.lidar.n_beams}
    if config.beams:
        sensors["scan_dense_beams"] = config.beams
    if config.cloud != "none":
        sensors |= {"cloud": config.cloud, "columns": config.columns, "every": config.every}
        sensors |= {"cloud_range": sensing.CLOUD_RANGE, "cloud_sigma": sensing.CLOUD_SIGMA}
    if config.imu:
        sensors["imu_rate"] = poses.IMU_RATE
    return {
        "schema": RECORDING,
        "task": env.id,
        "tunnel": plan.name,
        "provenance": plan.provenance,
        "lining": config.lining or plan.default_lining,
        "agent": config.policy or config.agent,
        "observed": first,
        "steps": len(trace.command),
        "period": trace.period,
        "epoch": messages.EPOCH,
        "frames": {"odom": "base_link at the start", "sensors": "turned like base_link, lidar_height above it"},
        "sensors": sensors,
        "topics": topics,
        "versions": {name: version(name) for name in _LIBRARIES},
    }


def outcome(trace: Trace, seed: int, severity: int | None) -> dict[str, Any]:
    """How the episode was drawn and how it ended."""
    state = trace.state
    moved = np.hypot(*np.diff(np.asarray(state.position, np.float64), axis=0).T)
    return {
        "seed": seed,
        "severity": severity,
        "success": trace.success,
        "contact": trace.contact,
        "travelled": float(moved.sum()),
        "station_first": float(state.station[0]),
        "station_last": float(state.station[-1]),
    }


def truth(config: Recording, recording: Path, outcome: dict[str, Any], topics: dict[str, Any]) -> dict[str, Any]:
    """What belongs to the truth, and to which recording it belongs."""
    bag = recording / f"{recording.name}.mcap"
    return {
        "schema": TRUTH,
        "episode": config.episode,
        "list_sha256": None if config.episode is None else SHA256,
        **outcome,
        "recording_sha256": hashlib.sha256(bag.read_bytes()).hexdigest(),
        "topics": topics,
        "files": {
            "lidar.tum": "poses of the LiDARs in the tunnel frame",
            "base_link.tum": "poses of base_link in the tunnel frame",
            "axis.csv": "centre of the track: station, x, y, z, m",
        },
    }


def write(folder: Path, content: dict[str, Any]) -> None:
    """The facts of a folder, in a file called like it."""
    (folder / f"{folder.name}.json").write_text(json.dumps(content, indent=1, default=str) + "\n")
