"""One drive of a few sweeps, written in any convention of headers and point times that drivers have."""

from pathlib import Path

import numpy as np

from scene.survey.lidar import Lidar, Sweep
from scene.survey.messages import CLOUD_TYPE, EPOCH, Convention, Recorder, chunks_of, encode

RATE, RAYS = 10.0, 400
OFFSET = np.rint(0.098e9 * np.arange(RAYS) / (RAYS - 1)).astype(np.int64)  # ns
LIDAR = Lidar("lidar", OFFSET, 0, np.arange(RAYS) % 16, lambda *_: np.zeros((RAYS, 3)), 0.0, 100.0, 0.0, 0.0)


def sweeps(count: int) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Start, points and times after it of sweeps at 10 Hz that last 98 ms."""
    rng = np.random.default_rng(3)
    return [(EPOCH + k / RATE, rng.uniform(1, 9, (RAYS, 3)).astype(np.float32), 1e-9 * OFFSET) for k in range(count)]


def write_convention(path: Path, count: int = 12, point_times: str = "header", **how) -> Path:
    """A recording of `sweeps` in a `Convention`; returns what a user would name."""
    convention = Convention(point_times=point_times, **how)
    convention.check()
    zero, starts = np.zeros(RAYS, bool), {part * count // convention.bags for part in range(1, convention.bags)}
    with Recorder(path, {"/points": CLOUD_TYPE}, convention) as bag:
        for k, (start, points, _) in enumerate(sweeps(count)):
            if k in starts:
                bag.start_part()
            begin = round((start - EPOCH) * 1e9)
            sweep = Sweep(k, begin, OFFSET, ~zero, points, zero.astype(np.uint8), zero)
            for chunk, lidar in chunks_of(sweep, LIDAR, convention):
                bag.write("/points", begin + 100_000_000, encode(chunk, lidar, convention))
    return bag.path
