"""What a user may say about an input where detection is not wanted or is wrong."""

from dataclasses import dataclass
from typing import Annotated

import tyro

# Flags without the path of the nested configs before them: `--unit mm`, not `--reconstruct.reading.unit mm`.
_FLAG = tyro.conf.arg(prefix_name=False)


@dataclass(frozen=True)
class ReadingConfig:
    """Overrides of what is detected.

    Attributes:
        topic: LiDAR topic of a bag; found by its type where not given.
        format: Of the input: bag, rosbag2, mcap, db3, scans, ply, pcd, las, e57, table, parquet, rings.
        unit: Of a registered cloud's or a ring survey's coordinates: m, mm, ft or us-ft.
        axes: Of a registered cloud: which of its axes point east, north and up, such as xyz, xzy or -yxz.
    """

    topic: Annotated[str | None, _FLAG] = None
    format: Annotated[str | None, _FLAG] = None
    unit: Annotated[str | None, _FLAG] = None
    axes: Annotated[str | None, _FLAG] = None
