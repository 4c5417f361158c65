"""Mounts of a carrier's instruments against its LiDAR: published presets, a YAML file, or a lever arm."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError, require_input

_ORTHONORMAL = 1e-3  # published matrices are rounded to 6 digits


@dataclass(frozen=True)
class Mount:
    """Transform from LiDAR coordinates to an instrument's: `p_instrument = rotation @ p_lidar + shift`."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]  # m

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """The instrument's origin in LiDAR coordinates, m."""
        return -self.rotation.T @ self.shift


@dataclass(frozen=True)
class Calibration:
    """The places of prism and IMU, seen from the LiDAR."""

    name: str  # Preset, file or lever arm, for the manifest
    prism: Float[np.ndarray, "3"]  # Position of the prism in LiDAR coordinates, m
    imu: dict[str, Mount]  # Maps LiDAR coordinates to the IMU's, by topic of the IMU


def _orthonormal_mount(rotation: list[list[float]], shift: list[float]) -> Mount:
    u, _, vt = np.linalg.svd(np.array(rotation))
    return Mount(u @ vt, np.array(shift))


def _quaternion_mount(shift: list[float], wxyz: list[float]) -> Mount:
    return Mount(Rotation.from_quat([*wxyz[1:], wxyz[0]]).as_matrix(), np.array(shift))


# Source: GEODE (PengYu-Team/GEODE_dataset, arXiv 2409.04961). Its scripts give (t, q wxyz), "γ to Leica", and
# take a LiDAR pose P to P · inv(T): T maps LiDAR coordinates to the target's, whose origin is inv(T) · 0.
_LEICA_GAMMA = _quaternion_mount([0.00947221, -0.308202, -0.365733], [0.999901, -0.00492765, 0.00575961, 0.0117651])
_LEICA_BETA = _quaternion_mount([-0.0108864, 0.293397, -0.452674], [0.999991, 0.000903519, 0.0035434, -0.00220342])
_GNSS_GAMMA = _quaternion_mount([0.0305, -0.5959, 0.0902], [0.9998828, -0.0057758, 0.0022253, 0.0140019])
_GNSS_ALPHA = _quaternion_mount([0.0090, -0.2925, 0.4533], [0.9999909, -0.0009, -0.00355, 0.0022])
# Source: GEODE, `T_IMU_LiDAR`, p_imu = T p_lidar, of the external Xsens MTi-30.
_MTI_GAMMA = _orthonormal_mount(
    [[0.99962, 0.027463, 0.002445], [-0.027517, 0.999299, 0.025398], [-0.001746, -0.025456, 0.999674]],
    [0.049258, -0.0125, 0.026946],
)
_MTI_BETA = _orthonormal_mount(
    [[0.998638, 0.052001, -0.004278], [-0.051937, 0.998554, 0.0139], [0.004994, -0.013659, 0.999894]],
    [-0.027172, -0.034873, 0.062643],
)
_MTI_ALPHA = _orthonormal_mount(
    [[0.9999, 0.0049, 0.0153], [-0.0050, 1.0, 0.0021], [-0.0153, -0.0022, 0.9999]], [0.0961, -0.1338, 0.3032]
)
# Source: FAST-LIO's avia.yaml, p_imu = p_lidar + t: axes parallel, the chip at minus this in LiDAR coordinates.
_AVIA = Mount(np.eye(3), np.array([0.04165, 0.02326, -0.0284]))

_GAMMA = {"/livox/imu": _AVIA, "/imu/data": _MTI_GAMMA}
PRESETS = {
    "geode-gamma": Calibration("geode-gamma", _LEICA_GAMMA.origin, _GAMMA),
    "geode-beta": Calibration("geode-beta", _LEICA_BETA.origin, {"/imu/data": _MTI_BETA}),
    "geode-gamma-gnss": Calibration("geode-gamma-gnss", _GNSS_GAMMA.origin, _GAMMA),
    "geode-alpha-gnss": Calibration("geode-alpha-gnss", _GNSS_ALPHA.origin, {"/imu/data": _MTI_ALPHA}),
    # The ground truth of the Tunneling sequences is given in α's own LiDAR frame.
    "geode-alpha": Calibration("geode-alpha", np.zeros(3), {"/imu/data": _MTI_ALPHA}),
}
# `/ouster/imu` is in no preset: Ouster states where the IMU is against the sensor's frame, but its driver publishes
# clouds in that frame (`os_sensor`) or in the LiDAR's (`os_lidar`), half a turn apart, by a setting nobody recorded.
# What is known of an IMU by itself: Livox's sits in the housing.
UNCALIBRATED = Calibration("none: the control is taken for the LiDAR's own origin", np.zeros(3), {"/livox/imu": _AVIA})


def find_calibration(text: str | None) -> Calibration:
    """Return a calibration from a user's text: a preset, a YAML file, or the prism's `x,y,z` in LiDAR coordinates, m.

    Raises `RecordingError` for any other text and for a malformed file.
    """
    if text is None:
        return UNCALIBRATED
    if text in PRESETS:
        return PRESETS[text]
    numbers = text.replace(",", " ").split()
    try:
        lever = np.array([float(number) for number in numbers])
    except ValueError:
        lever = np.empty(0)
    if lever.shape == (3,) and np.isfinite(lever).all():
        return replace(UNCALIBRATED, name=text, prism=lever)
    if text.lower().endswith((".yaml", ".yml")):
        return load_calibration(Path(text))
    raise RecordingError(
        f"{text}: no calibration of that name; it is a preset ({', '.join(sorted(PRESETS))}), a .yaml file, "
        "or a lever arm x,y,z in metres"
    )


def load_calibration(path: Path) -> Calibration:
    """Reads `prism: [x, y, z]` (m, LiDAR coordinates) and `imu: {topic: {rotation: 3x3, shift: [x, y, z]}}`.

    An IMU's transform maps LiDAR coordinates to the IMU's. Both keys may be left out; any other is refused. Raises
    `RecordingError`, which names the key or shape that is wrong.
    """
    require_input(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise RecordingError(f"{path}: not a YAML file ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict) or set(content) - {"prism", "imu"}:
        raise RecordingError(f"{path}: a calibration has the keys prism and imu, found {content!r:.80}")
    imus = content.get("imu") or {}
    if not isinstance(imus, dict):
        raise RecordingError(f"{path}: imu must map topics to rotation and shift, found {imus!r:.80}")
    mounts = {}
    for topic, entry in imus.items():
        if not isinstance(entry, dict):
            raise RecordingError(f"{path}: imu {topic} must have rotation and shift, found {entry!r:.80}")
        rotation = _read_numbers(path, f"imu {topic} rotation", entry.get("rotation", np.eye(3)), (3, 3))
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(rotation) < 0:
            raise RecordingError(f"{path}: imu {topic} rotation is no rotation matrix")
        mounts[str(topic)] = _orthonormal_mount(
            rotation.tolist(), _read_numbers(path, f"imu {topic} shift", entry.get("shift"), (3,)).tolist()
        )
    prism = _read_numbers(path, "prism", content.get("prism", np.zeros(3)), (3,))
    return Calibration(path.name, prism, {**UNCALIBRATED.imu, **mounts})


def _read_numbers(path: Path, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        expected = " by ".join(str(size) for size in shape)
        raise RecordingError(f"{path}: {name} must be {expected} numbers, found {value!r:.80}")
    return array
