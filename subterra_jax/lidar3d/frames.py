"""Straight frames along a bore: its axis cut, by planes square to it, into blocks of a few metres."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Straight frames along the axis.

    Attributes:
        centre: Origin of each frame, exactly representable in float32, m, `(b, 3)`.
        turn: Rows are the frame's axes: along, left, up, exactly representable in float32, `(b, 3, 3)`.
        back: The plane where the block begins, in its own frame, as a unit normal along the axis and an offset:
            inside, `normal · point >= offset`; m, `(b, 4)`.
        front: The plane where it ends, where `normal · point <= offset`, `(b, 4)`.
        ends: Stations of its two planes, m, `(b, 2)`.
    """

    centre: Float[np.ndarray, "b 3"]
    turn: Float[np.ndarray, "b 3 3"]
    back: Float[np.ndarray, "b 4"]
    front: Float[np.ndarray, "b 4"]
    ends: Float[np.ndarray, "b 2"]


def cut_blocks(
    station: Float[np.ndarray, "n"],
    position: Float[np.ndarray, "n 3"],
    tangent: Float[np.ndarray, "n 3"],
    length: float,
) -> Blocks:
    """Blocks of about `length` m, or the whole where it is shorter."""
    joint = np.linspace(0.0, station[-1], max(1, round(station[-1] / length)) + 1)

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(joint, station, column) for column in values.T], axis=-1)

    point, normal = at(position), at(tangent)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centre = _as_float32((point[1:] + point[:-1]) / 2)
    along = point[1:] - point[:-1]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], along)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    turn = _as_float32(np.stack([along, left, np.cross(along, left)], axis=1))

    def plane(which: slice) -> np.ndarray:
        facing = np.einsum("bij,bj->bi", turn, normal[which])
        offset = np.einsum("bij,bj->bi", turn, point[which] - centre)
        return np.column_stack([facing, np.sum(facing * offset, axis=1)])

    ends = np.column_stack([joint[:-1], joint[1:]])
    return Blocks(centre, turn, plane(slice(None, -1)), plane(slice(1, None)), ends)


def _as_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)
