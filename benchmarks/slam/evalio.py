"""Recordings as `evalio`'s pipelines take them: sweeps as images of points, IMU samples, parameters of the sensors.

Source of the conventions: evalio 0.6.1, `evalio.datasets.loaders`; poses are those of the IMU.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from evalio._cpp.helpers import (
    DataType,
    Field,
    PointCloudMetadata,
    fill_col_by_map,
    fill_col_row_major,
    pc2_to_evalio,
    reorder_points,
)
from evalio.types import SE3, SO3, ImuMeasurement, ImuParams, LidarParams, Stamp

from benchmarks.slam.reading import CALIBRATION, POINT, read_samples

_KINDS = {"<f4": 7, "<u4": 6, "<u2": 4}  # codes of `sensor_msgs/PointField`
_FIRED_RINGS = [0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15]  # rings of a VLP-16 in the order of firing


class EvalioRecording:
    """A recording of the arena."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._facts = folder, yaml.safe_load((folder / CALIBRATION).read_text())

    @property
    def mount(self) -> SE3:
        """Pose of the LiDAR in the IMU's frame."""
        return SE3(SO3.identity(), np.array(self._facts["imu"]["shift_from_lidar"]))

    @property
    def imu(self) -> ImuParams:
        imu = self._facts["imu"]
        return ImuParams(
            gyro=imu["gyro_noise_density"], accel=imu["accel_noise_density"], gyro_bias=imu["gyro_random_walk"],
            accel_bias=imu["accel_random_walk"], bias_init=1e-2, integration=1e-7,
            gravity=np.array([0.0, 0.0, -imu["gravity"]]), rate=imu["rate"], brand="simulated", model="MEMS",
        )  # fmt: skip

    @property
    def lidar(self) -> LidarParams:
        lidar = self._facts["lidar"]
        return LidarParams(
            num_rows=lidar["rows"], num_columns=lidar["columns"], min_range=lidar["range_min"],
            max_range=lidar["range_max"], rate=lidar["rate"], brand="simulated", model=lidar["model"],
        )  # fmt: skip

    def samples(self) -> Iterator[Any]:
        """Yields sweeps and IMU samples in order; beams without a return are points at the sensor."""
        for stamp, content in read_samples(self._folder):
            if isinstance(content, tuple):
                yield ImuMeasurement(Stamp.from_nsec(stamp), content[1], content[0])
            else:
                yield self._sweep(stamp, content)

    def _sweep(self, stamp: int, points: np.ndarray) -> Any:
        lidar = self._facts["lidar"]
        cloud = PointCloudMetadata(
            stamp=Stamp.from_nsec(stamp), height=1, width=len(points), row_step=points.nbytes,
            point_step=points.itemsize, is_bigendian=0, is_dense=0,
        )  # fmt: skip
        fields = [
            Field(name=name, datatype=DataType(_KINDS[kind.str]), offset=offset)
            for name, (kind, offset, *_) in (POINT.fields or {}).items()
        ]
        sweep = pc2_to_evalio(cloud, fields, points.tobytes())
        if lidar["model"].startswith("os1"):  # comes row by row, whole
            fill_col_row_major(sweep)
            return sweep
        fired = np.argsort(_FIRED_RINGS).tolist() if lidar["model"] == "vlp16" else [*range(6)]
        fill_col_by_map(sweep, [*fired, *[-1] * (128 - len(fired))])
        reorder_points(sweep, lidar["rows"], lidar["columns"])
        return sweep
