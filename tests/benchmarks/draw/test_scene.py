"""A camera anywhere in a scene."""

import numpy as np

from benchmarks.draw.scene import Pose


def test_the_axes_of_a_camera_are_right_up_and_ahead():
    pose = Pose(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0]), np.pi / 2, 120, 90)
    np.testing.assert_allclose(pose.axes, [[0, -1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
