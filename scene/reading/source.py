"""What every reader of registered clouds hands back."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

BATCH = 500_000  # points of a chunk: 12 MB of coordinates


@dataclass(frozen=True)
class CloudSource:
    """A cloud that has been opened but not read.

    Attributes:
        format: With its version, for the manifest.
        chunks: Starts reading: x, y, z as stored, `(n, 3)` float64 each, of bounded size.
        sample: Points from all over the file, or corners of its box, by which a unit can be told, `(k, 3)`.
        unit: `m`, `mm` or a kind of foot, where the format or a header says so.
        count: Points in all, where the file knows.
    """

    format: str
    chunks: Callable[[], Iterator[Float[np.ndarray, "n 3"]]]
    sample: Float[np.ndarray, "k 3"]
    unit: str | None = None
    count: int | None = None


def stacked(records: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """x, y and z of structured records as float64.

    Raises:
        ValueError: A coordinate is missing.
    """
    missing = [name for name in "xyz" if name not in (records.dtype.names or ())]
    if missing:
        raise ValueError(f"it has no field {', '.join(missing)}")
    with np.errstate(invalid="ignore"):  # bit patterns that are no number; they are dropped later
        return np.stack([records[name] for name in "xyz"], axis=1).astype(np.float64)


def from_records(format: str, records: np.ndarray) -> CloudSource:
    """A source over records in memory or mapped from the file."""

    def chunks() -> Iterator[np.ndarray]:
        for start in range(0, len(records), BATCH):
            yield stacked(records[start : start + BATCH])

    return CloudSource(format, chunks, stacked(records[:: max(len(records) // 2000, 1)]), count=len(records))
