"""Short recordings made by hand, whose every number is known."""

from typing import Any

import numpy as np

from subterra_jax.viewer.recording import N_POSE, Recording


def straight(n: int = 21, **changes: Any) -> Recording:
    """A drive along x at 2 m/s in a straight tunnel; the odometer reads 10 % too much and the estimate is 1 m ahead."""
    x = 0.2 * np.arange(n, dtype=np.float32)
    zero = np.zeros(n, np.float32)
    estimate = np.stack([x + 1.0, np.full(n, 0.5)], axis=-1).astype(np.float32)
    estimate[0] = np.nan
    fields: dict[str, Any] = {
        "task": "Subterra/StopAt-v1",
        "agent": "by hand",
        "tunnel": "t",
        "tunnel_sha256": "0",
        "lining": "smooth",
        "seed": 3.0,
        "period": 0.1,
        "radius": 0.35,
        "range_max": 30.0,
        "length": 60.0,
        "start": 0.0,
        "goal": 40.0,
        "success": 1.0,
        "contact": 0.0,
        "position": np.stack([x, zero], axis=-1),
        "heading": zero,
        "station": x,
        "odometry": np.stack([1.1 * x, zero], axis=-1),
        "ranges": np.tile(np.array([30.0, 2.0, 3.0, 4.0], np.float32), (n, 1)),
        "command": np.stack([zero + 2.0, zero], axis=-1),
        "estimate": estimate,
        "reward": zero + 0.5,
        "coverage": x / 60.0,
        "cloud": np.zeros((n, 0, 3), np.float32),
        "boxes": np.zeros((0, 6), np.float32),
        "trunk": zero,
        "pose": np.zeros((n, 0, N_POSE), np.float32),
        "points": np.zeros((n, 0, 3), np.float32),
    }
    return Recording(**{**fields, **changes})
