"""Beams that came back with nothing, from recordings that keep a place for them."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from scene.reading.recording import Recording
from scene.reading.scans import POINTCLOUD2_TYPE, TIME_FIELDS, Scan, make_scan

SILENT = 1e6  # m: where the point of a beam without return is put, in its direction
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_FEWEST = 8  # returns of a ring or column that tell its direction


def organised(recording: Recording) -> bool:
    """Whether the recording holds sweeps as rings by columns, with a time for beams without return (Ouster).

    A Livox message keeps a place for them too, but nothing in it tells where they looked.
    """
    for message in _messages(recording):
        names = {field.name for field in message.fields}
        whole = message.height * message.width * message.point_step == len(message.data)
        return bool(whole and message.height > 1 and message.width > 1 and names & set(TIME_FIELDS))
    return False


def scans(recording: Recording) -> Iterator[Scan]:
    """Sweeps in which a beam without return is a point `SILENT` metres away in the direction that it looked.

    Raises:
        ValueError: A message is no organised sweep.
    """
    for message in _messages(recording):
        points, times, name = _fields(message)
        back = np.isfinite(points).all(axis=2) & (points != 0).any(axis=2)
        look, known = directions(points, back)
        filled = np.where((known & ~back)[..., None], SILENT * look, points)
        filled[~known & ~back] = 0.0
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        yield make_scan(stamp, filled.reshape(-1, 3), times.ravel(), name)[0]


def directions(
    points: Float[np.ndarray, "rings columns 3"], back: Bool[np.ndarray, "rings columns"]
) -> tuple[Float[np.ndarray, "rings columns 3"], Bool[np.ndarray, "rings columns"]]:
    """Where each beam of a sweep looked, and whether that is known, from the returns of its ring.

    A ring is a cone about the sensor's axis of rotation; its azimuth is that of the column plus a constant. Both
    constants are medians over the ring's own returns, so nothing of the maker's calibration is needed.
    """
    columns = points.shape[1]
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    elevation = np.arctan2(points[..., 2], np.hypot(points[..., 0], points[..., 1]))
    turn = 2.0 * np.pi * np.arange(columns) / columns
    # The sweep turns one way or the other; the right one leaves the smaller spread.
    residuals = [_wrapped(azimuth - sense * turn) for sense in (1.0, -1.0)]
    sense, residual = max(
        zip((1.0, -1.0), residuals, strict=True),
        key=lambda pair: float(np.abs(np.exp(1j * pair[1][back]).sum())),
    )
    look, known = np.zeros_like(points, dtype=float), np.zeros(back.shape, bool)
    for ring in np.flatnonzero(back.sum(axis=1) >= _FEWEST):
        seen = back[ring]
        middle = np.angle(np.exp(1j * residual[ring, seen]).sum())
        offset = middle + np.median(_wrapped(residual[ring, seen] - middle))
        level = np.median(elevation[ring, seen])
        heading = sense * turn + offset
        look[ring] = np.stack(
            [np.cos(level) * np.cos(heading), np.cos(level) * np.sin(heading), np.full(columns, np.sin(level))], axis=1
        )
        known[ring] = True
    return look, known


def _messages(recording: Recording) -> Iterator[Any]:
    connections = [
        c for c in recording.reader.connections if (c.topic, c.msgtype) == (recording.topic, POINTCLOUD2_TYPE)
    ]
    if not connections:
        return
    for _, _, raw in recording.reader.messages(connections=connections):
        yield recording.deserialize(bytes(raw), POINTCLOUD2_TYPE)


def _fields(message: Any) -> tuple[Float[np.ndarray, "rings columns 3"], Int[np.ndarray, "rings columns"], str]:
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: (order + _TYPES[f.datatype], f.offset) for f in message.fields if f.datatype in _TYPES}
    name = next(time for time in TIME_FIELDS if time in fields)
    wanted = ["x", "y", "z", name]
    layout = np.dtype({
        "names": wanted, "formats": [fields[n][0] for n in wanted], "offsets": [fields[n][1] for n in wanted],
        "itemsize": message.point_step,
    })  # fmt: skip
    if message.height * message.width * message.point_step != len(message.data):
        raise ValueError(f"a sweep of {message.height} x {message.width} points in {len(message.data)} bytes")
    rows = np.frombuffer(np.asarray(message.data, np.uint8).tobytes(), layout).reshape(message.height, message.width)
    return np.stack([rows[axis] for axis in "xyz"], axis=-1).astype(float), rows[name], name


def _wrapped(angle: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
