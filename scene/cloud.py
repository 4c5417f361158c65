"""The registered cloud: points in one frame, thinned to one weighted point per voxel."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

# 21 bits an axis: at 4 cm, 84 km each way.
_BITS = 21
_HALF = 1 << (_BITS - 1)
_MERGE_AT = 8_000_000


@dataclass(frozen=True)
class Cloud:
    """Points in the tunnel frame."""

    points: Float[np.ndarray, "n 3"]  # m, less `origin`, `(n, 3)` float32
    weights: Float[np.ndarray, " n"]  # Returns that each point stands for
    origin: Float[np.ndarray, "3"]  # Whole-metre offset of the tunnel frame in the input's frame, m
    returns: int  # Returns read in all
    voxel: float  # Edge length of the voxels, m
    # Mean intensity of each point's returns, as the sensor scales it; `None` where the input tells none
    intensity: Float[np.ndarray, " n"] | None = None


def thin_cloud(cloud: Cloud, voxel: float) -> Cloud:
    """Return the means of a cloud's points by larger voxels, m, in the same frame; they are weighted by points."""
    again = VoxelMean(voxel)
    points = cloud.points.astype(np.float64)
    again.add(points if cloud.intensity is None else np.column_stack([points, cloud.intensity]))
    coarse = again.cloud()
    return replace(coarse, points=(coarse.points + coarse.origin).astype(np.float32), origin=cloud.origin)


class VoxelMean:
    """Accumulates points batch by batch and keeps the mean of each voxel: bounded by the surface, not by the time.

    Attributes:
        voxel: Edge length, m.
        finite: Finite points given.
        returns: Finite points within 2²⁰ voxels of the first; the others are left out.
    """

    def __init__(self, voxel: float) -> None:
        self.voxel = voxel
        self.finite = self.returns = 0
        self._origin: np.ndarray | None = None
        self._parts: list[tuple[np.ndarray, np.ndarray]] = []
        self._pending = 0

    def add(self, points: Float[np.ndarray, "n k"]) -> None:
        """Adds points in the fixed frame, m, less those not finite; a fourth column is their intensity."""
        points = points[np.isfinite(points[:, :3]).all(axis=1)]
        self.finite += len(points)
        if not len(points):
            return
        if self._origin is None:
            self._origin = np.floor(np.median(points[:, :3], axis=0))
        local = points[:, :3] - self._origin
        inside = (np.abs(local) < (_HALF - 1) * self.voxel).all(axis=1)
        local = local[inside]
        intensity = points[inside, 3:4] if points.shape[1] > 3 else np.full((len(local), 1), np.nan)
        cell = np.floor(local / self.voxel).astype(np.int64)
        key = ((cell[:, 0] + _HALF) << 2 * _BITS) | ((cell[:, 1] + _HALF) << _BITS) | (cell[:, 2] + _HALF)
        sums = np.concatenate([local, np.ones((len(local), 1)), intensity], axis=1)
        self._parts.append(_merge_cells(key, sums))
        self._pending += len(self._parts[-1][0])
        if self._pending > _MERGE_AT:
            self._compact()
        self.returns += int(inside.sum())

    def cloud(self) -> Cloud:
        if not self._parts or self._origin is None:
            return Cloud(np.empty((0, 3), np.float32), np.empty(0, np.float32), np.zeros(3), 0, self.voxel)
        self._compact()
        sums = self._parts[0][1]
        weights = sums[:, 3]
        points = (sums[:, :3] / weights[:, None]).astype(np.float32)
        intensity = None if np.isnan(sums[:, 4]).all() else (sums[:, 4] / weights).astype(np.float32)
        return Cloud(points, weights.astype(np.float32), self._origin, self.returns, self.voxel, intensity)

    def _compact(self) -> None:
        if len(self._parts) > 1:
            keys, sums = zip(*self._parts, strict=True)
            self._parts = [_merge_cells(np.concatenate(keys), np.concatenate(sums))]
        self._pending = 0


def _merge_cells(key: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(key, kind="stable")
    key, sums = key[order], sums[order]
    starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]])) if len(key) else np.empty(0, np.intp)
    return key[starts], np.add.reduceat(sums, starts, axis=0) if len(starts) else sums
