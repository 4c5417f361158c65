"""Gymnasium, one B2 in MuJoCo's own engine: `gymnasium.make("Subterra/B2Traverse-v0")`, `"Subterra/B2Walk-v0"`."""

from pathlib import Path
from typing import Any, Literal

import jax

from subterra_jax.b2 import TRAVERSE, WALK
from subterra_jax.b2.single import SingleB2  # first: it says how MuJoCo is to draw

# isort: split
from subterra_jax.b2 import missions, tasks
from subterra_jax.b2 import policy as gaits
from subterra_jax.b2.engine import MujocoPhysics, SceneWalk
from subterra_jax.b2.params import WalkParams, WalkState
from subterra_jax.b2.policy import WalkPolicy
from subterra_jax.tunnel.plan import TunnelPlan


class B2Env(SingleB2):
    """One B2 that walks a tunnel on a frozen gait; action and observation are those of the planar task.

    A step is 0.2 s: ten of the gait, fifty of physics. `info` tells `station`, `fall` and `contact` among others.

    Args:
        task: Id of the task.
        tunnel: As for `missions.make`.
        lining: As for `missions.make`.
        scene: A built scene folder to walk in, instead of a tunnel.
        policy: The gait: its file or name, or `trot`.
        odometer: `legs`, the robot's own; or `drift`, the model of the planar tasks.
        render_mode: None or `rgb_array`.
        width: Of a picture, pixels.
        height: Of a picture, pixels.
        **overrides: As for `missions.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = TRAVERSE,
        tunnel: TunnelPlan | str | Path | None = None,
        lining: str | None = None,
        *,
        scene: str | Path | None = None,
        policy: WalkPolicy | str | Path = gaits.RELEASED,
        odometer: Literal["legs", "drift"] = "legs",
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **overrides: Any,
    ):
        super().__init__(render_mode, width, height)
        with jax.default_device(self._cpu):
            self.env, self.params = missions.make(
                task, tunnel, lining, scene=scene, policy=policy, odometer=odometer, engine="mujoco", **overrides
            )
        self.walk = self.env.motion.walk
        self._ready()

    def walking(self) -> tuple[WalkState, WalkParams]:
        """State and parameters of the walking part."""
        return self.state.legs.walk, self.params.walk


class B2WalkEnv(SingleB2):
    """One B2 that learns to walk: twelve joint offsets fifty times a second, as `subterra_jax.b2.walk.WalkEnv` has it.

    Args:
        task: Id of the task.
        tunnel: As for `tasks.make`.
        lining: As for `tasks.make`.
        scene: A built scene folder to walk in, instead of a tunnel.
        render_mode: None or `rgb_array`.
        width: Of a picture, pixels.
        height: Of a picture, pixels.
        **overrides: As for `tasks.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = WALK,
        tunnel: TunnelPlan | str | Path | None = None,
        lining: str | None = None,
        *,
        scene: str | Path | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **overrides: Any,
    ):
        super().__init__(render_mode, width, height)
        with jax.default_device(self._cpu):
            self.env, self.params = tasks.make(task, tunnel, lining, scene=scene, physics=MujocoPhysics(), **overrides)
        if scene is not None:
            self.env = SceneWalk.of(self.env, Path(scene), lining)
        self.walk = self.env
        self._ready()

    def walking(self) -> tuple[WalkState, WalkParams]:
        """State and parameters."""
        return self.state, self.params
