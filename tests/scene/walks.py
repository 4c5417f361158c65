"""A walk whose every derivative is known: what an IMU and a total station would report of it."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scene.poses.imu import GRAVITY, Inertial
from scene.poses.trajectory import Control

LEVER = np.array([0.1, -0.3, 0.35])


def attitude(times: np.ndarray, mounted: float = 0.0) -> Rotation:
    """Along an arc of 100 m radius, swaying in every axis; `mounted` turns the body about its own up, rad."""
    turns = [0.3 + 0.01 * times + 0.1 * np.sin(0.9 * times), 0.06 * np.sin(1.3 * times), 0.04 * np.sin(1.7 * times)]
    return Rotation.from_euler("ZYX", np.stack(turns, axis=1)) * Rotation.from_euler("z", mounted)


def position(times: np.ndarray) -> np.ndarray:
    """At 1 m/s along the arc, 0.1 m from side to side."""
    heading, side = 0.3 + 0.01 * times, 100 - 0.1 * np.sin(1.1 * times)
    return np.stack(
        [side * np.sin(heading) + 500, -side * np.cos(heading) - 900, 0.02 * times + 0.02 * np.sin(11 * times)], axis=1
    )


def inertial(duration: float, mounted: float = 0.0, bias: float = 0.003) -> Inertial:
    times, h = np.arange(0, duration, 0.005), 1e-4
    before, here, after = (attitude(times + k * h, mounted) for k in (-1, 0, 1))
    pull = (position(times + 1e-3) - 2 * position(times) + position(times - 1e-3)) / 1e-6 + (0, 0, GRAVITY)
    return Inertial(times, (before.inv() * after).as_rotvec() / (2 * h) + bias, here.inv().apply(pull), "/imu")


def control(duration: float, mounted: float = 0.0, sigma: float = 0.0005) -> Control:
    times = np.arange(0.2, duration - 0.2, 0.33)
    places = position(times) + attitude(times, mounted).apply(LEVER)
    noise = sigma * np.random.default_rng(0).standard_normal(places.shape)
    return Control(times, places + noise, Path("prism.tum"), 0)
