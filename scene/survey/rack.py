"""One rack with three LiDARs, their IMUs and a prism, after GEODE's devices α, β and γ.

All three devices of GEODE's tunnelling runs hang on one rack, and its scripts place each LiDAR against a common target:
β and γ against the total station's prism, α and γ against the GNSS antenna. That is where the mounts come from.

Source: PengYu-Team/GEODE_dataset, evaluation scripts and calibration files [geode.md].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.survey.config import LidarName


@dataclass(frozen=True)
class Mount:
    """Transform between two instruments: p_instrument = rotation @ p_other + shift."""

    rotation: Float[np.ndarray, "3 3"]  # `(3, 3)`
    shift: Float[np.ndarray, "3"]  # m

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """The instrument's origin in the other's coordinates, m."""
        return -self.rotation.T @ self.shift

    def after(self, first: "Mount") -> "Mount":
        """Return the mount that applies `first`, then this one."""
        return Mount(self.rotation @ first.rotation, self.rotation @ first.shift + self.shift)

    def inverse(self) -> "Mount":
        """Return the mount from the instrument's coordinates to the other's."""
        return Mount(self.rotation.T, self.origin)


def _target(shift: list[float], wxyz: list[float]) -> Mount:
    return Mount(Rotation.from_quat([*wxyz[1:], wxyz[0]]).as_matrix(), np.array(shift))


def _printed(rotation: list[list[float]], shift: list[float]) -> Mount:
    """Return a mount whose printed digits are made orthonormal."""
    u, _, vt = np.linalg.svd(np.array(rotation))
    return Mount(u @ vt, np.array(shift))


# LiDAR coordinates to those of the target, as printed: t, q as w x y z.
PRISM = _target([0.00947221, -0.308202, -0.365733], [0.999901, -0.00492765, 0.00575961, 0.0117651])  # of γ
_PRISM_BETA = _target([-0.0108864, 0.293397, -0.452674], [0.999991, 0.000903519, 0.0035434, -0.00220342])
_GNSS_GAMMA = _target([0.0305, -0.5959, 0.0902], [0.9998828, -0.0057758, 0.0022253, 0.0140019])
_GNSS_ALPHA = _target([0.0090, -0.2925, 0.4533], [0.9999909, -0.0009, -0.00355, 0.0022])

# Each LiDAR against the Avia: p_lidar = rotation @ p_avia + shift.
LIDARS: dict[LidarName, Mount] = {
    "avia": Mount(np.eye(3), np.zeros(3)),
    "vlp16": _GNSS_ALPHA.inverse().after(_GNSS_GAMMA),
    "os1": _PRISM_BETA.inverse().after(PRISM),
}


@dataclass(frozen=True)
class Imu:
    """An IMU of one device."""

    topic: str  # Topic of its messages
    frame: str  # Its frame id
    rate: float  # Samples per second, Hz
    mount: Mount  # Against the device's LiDAR
    in_g: bool = False  # True where accelerations are published in g
    orientation: bool = False  # True where it estimates its orientation


def _mti(rotation: list[list[float]], shift: list[float]) -> Imu:
    return Imu("/imu/data", "imu_link", 100.0, _printed(rotation, shift), orientation=True)


IMUS: dict[LidarName, tuple[Imu, ...]] = {
    "avia": (
        # In the housing, axes parallel; the offset is the one FAST-LIO ships. The driver publishes g.
        Imu("/livox/imu", "livox_frame", 200.0, Mount(np.eye(3), np.array([0.04165, 0.02326, -0.0284])), in_g=True),
        _mti(
            [[0.99962, 0.027463, 0.002445], [-0.027517, 0.999299, 0.025398], [-0.001746, -0.025456, 0.999674]],
            [0.049258, -0.0125, 0.026946],
        ),
    ),
    "vlp16": (
        _mti([[0.9999, 0.0049, 0.0153], [-0.0050, 1.0, 0.0021], [-0.0153, -0.0022, 0.9999]], [0.0961, -0.1338, 0.3032]),
    ),
    "os1": (
        # In the housing, axes parallel: 6.253, -11.775, 7.645 mm in Ouster's manual.
        Imu("/ouster/imu", "os_imu", 100.0, Mount(np.eye(3), np.array([-0.006253, 0.011775, -0.007645]))),
        _mti(
            [[0.998638, 0.052001, -0.004278], [-0.051937, 0.998554, 0.0139], [0.004994, -0.013659, 0.999894]],
            [-0.027172, -0.034873, 0.062643],
        ),
    ),
}


def prism_from(name: LidarName) -> Float[np.ndarray, "3"]:
    """Return the prism in the coordinates of a LiDAR, m."""
    mount = LIDARS[name]
    return mount.rotation @ PRISM.origin + mount.shift


def calibration(name: LidarName) -> dict[str, Any]:
    """Return the content of a calibration file of one device, per docs/formats.md."""
    return {
        "prism": np.round(prism_from(name), 9).tolist(),
        "imu": {
            imu.topic: {
                "rotation": np.round(imu.mount.rotation, 9).tolist(),
                "shift": np.round(imu.mount.shift, 9).tolist(),
            }
            for imu in IMUS[name]
        },
    }
