"""One drive written in any convention of headers and point times that drivers have."""

from pathlib import Path

import numpy as np

from tests.scene.messages import pointcloud2, write_bag1

UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
EPOCH, RATE, RAYS = 1.7e9, 10.0, 400


def sweeps(count: int) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Start, points and times after it of sweeps at 10 Hz that last 98 ms."""
    rng = np.random.default_rng(3)
    offset = 0.098 * np.arange(RAYS) / (RAYS - 1)
    return [(EPOCH + k / RATE, rng.uniform(1, 9, (RAYS, 3)).astype(np.float32), offset) for k in range(count)]


def write_convention(
    path: Path,
    unit: str = "s",
    reference: str = "start",
    kind: str = "f8",
    boot: float | None = None,
    bad: float = 0.0,
    count: int = 12,
    seed: int = 0,
    wrap: bool = False,
) -> Path:
    """A ROS1 bag of `sweeps` in one convention.

    Args:
        path: File to write.
        unit: Unit of the times.
        reference: `start`, `end` (times count from the header, at that part of the sweep), `epoch` (absolute), `boot`
            (absolute by a clock that began `boot` s before the first header), `constant` (one value a sweep).
        kind: Type of the field.
        boot: See `reference`.
        bad: Share of the points whose time underflowed.
        count: Sweeps.
        seed: Draws the bad points.
        wrap: Counts with 32 bits that pass their end.
    """
    rng, rows = np.random.default_rng(seed), []
    fields = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("timestamp", kind, 16)]
    for start, points, offset in sweeps(count):
        span = offset[-1]
        stamp = start + span if reference == "end" else start
        at = {
            "start": offset, "end": offset - span, "epoch": start + offset, "constant": np.full(RAYS, start),
            "boot": start - EPOCH + (boot or 0.0) + offset,
        }[reference] * UNITS[unit]  # fmt: skip
        if np.issubdtype(np.dtype(kind), np.integer):
            at = np.rint(at)
            at = at % 2**32 if wrap else at
        at = at.astype(kind)
        at[rng.random(RAYS) < bad] = np.array(2**32 - 1_000_000).astype(kind) if kind == "u4" else at.max() * 50 + 1
        columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "timestamp": at}
        rows.append((stamp, pointcloud2(stamp, fields, 24, columns)))
    return write_bag1(path, {"/points": rows})
