"""How somebody's legs moved between two rows of a recording, as MuJoCo passes it on while it is driven."""

from typing import Any

import numpy as np
from jaxtyping import Float

from subterra_jax.env import TunnelEnv
from subterra_jax.viewer.recording import N_POSE


class Gait:
    """Collects poses; of who rolls there are none.

    Args:
        env: The environment; one that walks must do so in MuJoCo's own engine.

    Attributes:
        walks: Whether it has legs.
    """

    def __init__(self, env: TunnelEnv):
        walk: Any = getattr(env.motion, "walk", None)
        self.walks = walk is not None
        self._poses: list[np.ndarray] = []
        if walk is not None:
            walk.physics.bench.watch = lambda data: self._poses.append(data.qpos[3:19].astype(np.float32))

    def standing(self) -> Float[np.ndarray, "m 16"]:
        """Before the first step."""
        if not self.walks:
            return np.zeros((0, N_POSE), np.float32)
        from subterra_jax.b2.kinematics import standing_pose
        from subterra_jax.b2.mission import PERIODS

        pose = np.concatenate([[1.0, 0.0, 0.0, 0.0], np.asarray(standing_pose()[0], np.float64)])
        return np.tile(pose.astype(np.float32), (PERIODS, 1))

    def taken(self, n_rows: int) -> Float[np.ndarray, "n_rows m 16"]:
        """What has come since the last call, in as many rows."""
        poses, self._poses = self._poses, []
        return np.array(poses, np.float32).reshape(n_rows, -1, N_POSE) if poses else np.zeros((n_rows, 0, N_POSE), "f4")
