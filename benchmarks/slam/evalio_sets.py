"""Sets of recordings as datasets of `evalio`, which runs its pipelines on them without ROS.

`EVALIO_CUSTOM=benchmarks.slam.evalio_sets SUBTERRA_SET=out/arena evalio run -d 'subterra/*' -p dlio -o out/evalio`
runs them from evalio's own command line.

Source of the conventions: evalio 0.6.1, `evalio.datasets.base` and `loaders`; poses are those of the IMU.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from evalio._cpp.helpers import (
    DataType,
    Field,
    PointCloudMetadata,
    fill_col_by_map,
    pc2_to_evalio,
    reorder_points,
)
from evalio.datasets import Dataset
from evalio.datasets.loaders import (
    LidarDensity,
    LidarFormatParams,
    LidarMajor,
    LidarPointStamp,
    LidarStamp,
    RosbagIter,
)
from evalio.types import SE3, SO3, ImuMeasurement, ImuParams, LidarParams, Stamp, Trajectory

from benchmarks.slam.reading import livox_points

SET = "SUBTERRA_SET"
_LIVOX_FIELDS = [("x", 7, 0), ("y", 7, 4), ("z", 7, 8), ("intensity", 7, 12), ("t", 6, 16), ("ring", 4, 20)]


def set_folder() -> Path:
    """Returns the set that the environment names."""
    return Path(os.environ.get(SET, "out/arena"))


class SubterraSet(Dataset):
    """Recordings of one set; its members are made by `open_set`."""

    @property
    def folder(self) -> Path:
        return set_folder() / "recordings" / self.value

    def _calibration(self) -> dict[str, Any]:
        return yaml.safe_load((self.folder / "calibration.yaml").read_text())

    def data_iter(self) -> RosbagIter:
        facts = self._calibration()
        organised = facts["lidar"]["model"].startswith("os1")
        layout = LidarFormatParams(
            stamp=LidarStamp.Start,
            point_stamp=LidarPointStamp.Start,
            major=LidarMajor.Row if organised else LidarMajor.Column,
            density=LidarDensity.AllPoints if organised else LidarDensity.OnlyValidPoints,
        )
        bag = self.folder / "recording"
        topics = facts["lidar"]["topic"], facts["imu"]["topic"]
        return _LivoxIter(bag, *topics, self.lidar_params(), lidar_format=layout, custom_col_func=_columns(facts))

    def ground_truth_raw(self) -> Trajectory | None:
        path = set_folder() / "truth" / self.value / "lidar.tum"
        if not path.is_file():
            return None
        return Trajectory.from_csv(path, ["sec", "x", "y", "z", "qx", "qy", "qz", "qw"], delimiter=" ")

    def imu_T_lidar(self) -> SE3:
        return SE3(SO3.identity(), np.array(self._calibration()["imu"]["shift_from_lidar"]))

    def imu_T_gt(self) -> SE3:
        """Returns the same: the truth is the LiDAR's."""
        return self.imu_T_lidar()

    def imu_params(self) -> ImuParams:
        imu = self._calibration()["imu"]
        return ImuParams(
            gyro=imu["gyro_noise_density"], accel=imu["accel_noise_density"], gyro_bias=imu["gyro_random_walk"],
            accel_bias=imu["accel_random_walk"], bias_init=1e-2, integration=1e-7,
            gravity=np.array([0.0, 0.0, -imu["gravity"]]), rate=imu["rate"], brand="simulated", model="MEMS",
        )  # fmt: skip

    def lidar_params(self) -> LidarParams:
        lidar = self._calibration()["lidar"]
        return LidarParams(
            num_rows=lidar["rows"], num_columns=lidar["columns"], min_range=lidar["range_min"],
            max_range=lidar["range_max"], rate=lidar["rate"], brand="simulated", model=lidar["model"],
        )  # fmt: skip

    def files(self) -> Sequence[str | Path]:
        return [self.folder / "calibration.yaml", self.folder / "recording" / "metadata.yaml"]

    @classmethod
    def dataset_name(cls) -> str:
        return "subterra"

    def environment(self) -> str:
        return "Tunnel, simulated"


def _columns(facts: dict[str, Any]) -> Any:
    """Returns what gives points their column, where their order does not say it: a VLP-16 fires its rings in turn."""
    if facts["lidar"]["model"] != "vlp16":
        return None
    fired = [*np.argsort(_FIRED_RINGS).tolist(), *[-1] * 112]
    return lambda scan: fill_col_by_map(scan, fired)


_FIRED_RINGS = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])  # rings in the order of firing


class _LivoxIter(RosbagIter):
    """Reads Livox's own message too, which evalio's iterator does not know."""

    def _convert_livox(self, raw: bytes) -> Any:
        stamp, points = livox_points(raw)
        cloud = PointCloudMetadata(
            stamp=Stamp.from_nsec(stamp), height=1, width=len(points), row_step=points.nbytes,
            point_step=points.itemsize, is_bigendian=0, is_dense=0,
        )  # fmt: skip
        fields = [Field(name=name, datatype=DataType(code), offset=offset) for name, code, offset in _LIVOX_FIELDS]
        scan = pc2_to_evalio(cloud, fields, points.tobytes())
        fill_col_by_map(scan, [*range(6), *[-1] * 122])
        reorder_points(scan, self.lidar_params.num_rows, self.lidar_params.num_columns)
        return scan

    def __iter__(self) -> Any:
        for connection, _, raw in self.reader.messages(connections=self.connections_lidar + self.connections_imu):
            if connection.msgtype.endswith("CustomMsg"):
                yield self._convert_livox(raw)
                continue
            message = self.reader.deserialize(raw, connection.msgtype)
            imu = connection.msgtype == "sensor_msgs/msg/Imu"
            yield self._imu_conversion(message) if imu else self._lidar_conversion(message)

    def lidar_iter(self) -> Any:
        return (one for one in self if not isinstance(one, ImuMeasurement))


def open_set(folder: Path, names: Sequence[str]) -> Any:
    """Returns the dataset of a set: an enumeration of its recordings."""
    os.environ[SET] = str(folder)
    enumerate_members: Any = SubterraSet  # the functional form of an enumeration, which evalio's stubs hide
    return enumerate_members("Subterra", {name.replace("-", "_"): name for name in names})


if (set_folder() / "recordings").is_dir():
    Subterra = open_set(set_folder(), sorted(path.name for path in (set_folder() / "recordings").iterdir()))
