"""Gymnasium: one B2 in MuJoCo's own engine, as `Subterra/B2Traverse-v1` and `Subterra/B2Walk-v1`."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from subterra_jax.adapters.kernel import first_cpu
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.adapters.task import Task, check_mode
from subterra_jax.host.task_ids import B2_TRAVERSE, WALK
from subterra_jax.physics.stage import scene_file
from subterra_jax.physics.view import RobotView
from subterra_jax.pictures.camera import TunnelChoice
from subterra_jax.tasks import make
from subterra_jax.tunnel.plan import TunnelPlan


def compile_for_cpu(function: Callable[..., Any], params: Any, *examples: Any) -> Callable[..., Any]:
    """Compile a function of params and arrays in the usual way, since physics waits for the host; see `Compile`."""
    with jax.default_device(first_cpu()):
        return functools.partial(jax.jit(function).lower(params, *examples).compile(), params)


class B2Env(SubterraEnv):
    """One B2 that walks a tunnel on a frozen gait, by the action and observation of the planar task; or learns to walk.

    A step is 0.2 s: ten control periods of the gait, fifty steps of physics; or one of `b2.walk.WalkEnv`, 0.02 s.
    `info` has `station`, `fall` and `contact` among others.

    Args:
        task: Id of the task.
        tunnel: A tunnel file, a name or a plan; the packaged tunnel if left out.
        lining: Variant of the walls.
        scene: A built scene folder to walk in, instead of a tunnel.
        render_mode: `None` or `rgb_array`.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.
        **options: As for `subterra_jax.make`: `policy`, `sensor` and so on.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = B2_TRAVERSE,
        tunnel: TunnelPlan | str | Path | None = None,
        lining: str | None = None,
        *,
        scene: str | Path | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **options: Any,
    ):
        check_mode(render_mode)
        with jax.default_device(first_cpu()):
            env, params = make(task, tunnel, lining, scene=scene, engine="mujoco", **options)
        self.metadata = {**self.metadata, "render_fps": 50 if task == WALK else 5}
        self.walk = env if task == WALK else env.motion.walk
        file = None if scene is None else scene_file(scene, lining)
        choice = TunnelChoice(tunnel, lining)
        self.camera = RobotView(self.walk.physics, params.track, choice, file, width, height)
        self._adopt(Task(env, params, flat=task == WALK, compile=compile_for_cpu), self.camera, render_mode)
