"""The camera of MuJoCo's pictures: it follows a robot through a scene, or through the bore of its tunnel."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from subterra_jax.pictures.renderer import import_mujoco, light_near, open_renderer
from subterra_jax.pictures.stage import Stretch, stage_spec
from subterra_jax.procedural import expand
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import Source, load_tunnel

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class TunnelChoice:
    """The tunnels of an environment by number."""

    tunnel: Source | Sequence[Source] = None  # as for `subterra_jax.make`
    lining: str | None = None  # as for `subterra_jax.make`
    # start and length of the stretch that the task cuts out, m; `None` for the whole
    stretch: tuple[float, float] | None = None
    texture: float = 0.0  # as for `subterra_jax.make`

    def plan(self, number: int) -> TunnelPlan:
        """Return the plan of a tunnel, with its bore where there is one.

        Raises:
            ValueError: It is a ready `Tunnel`, which holds no heights.
        """
        source: Any = self.tunnel
        if isinstance(source, str | Path):
            source = expand(str(source)) if len(expand(str(source))) > 1 else source
        if not (source is None or isinstance(source, str | Path | TunnelPlan | Tunnel)):
            source = source[number]
        if isinstance(source, Tunnel):
            raise ValueError("view='mujoco' needs the tunnel's name, file or plan: a ready Tunnel holds no heights")
        plan = source if isinstance(source, TunnelPlan) else load_tunnel(source, solid=True)
        return plan.stretch(self.stretch)


class FollowCamera:
    """Draws a robot from behind, in a scene or in a stretch of 100 m of its tunnel's bore at a time.

    Args:
        choice: The tunnels to draw.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.
        model: Model of a scene to draw instead.
        furnish: Adds to the model of a stretch what its plan does not hold.

    Attributes:
        model: Present model.
        data: Its data.
    """

    def __init__(
        self,
        choice: TunnelChoice,
        width: int,
        height: int,
        model: "mujoco.MjModel | None" = None,
        furnish: "Callable[[mujoco.MjSpec, Stretch], None] | None" = None,
    ):
        self._mujoco = import_mujoco("a picture by MuJoCo")
        self._choice, self._size, self._furnish = choice, (width, height), furnish
        self._renderer: mujoco.Renderer | None = None
        self._plans: dict[int, TunnelPlan] = {}
        self._stretch: Stretch | None = None
        self.model: mujoco.MjModel
        self.data: mujoco.MjData
        if model is not None:
            self._show(model)

    def follow(self, number: int, position: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "3"]) -> TunnelPlan:
        """Take the stretch of a tunnel around a robot, unless the present one shows it; return the tunnel.

        Args:
            number: Number of the tunnel.
            position: Position of the robot, m.
            ahead: Direction that it faces.

        Raises:
            ValueError: See `TunnelChoice.plan`.
        """
        if number not in self._plans:
            self._plans = {number: self._choice.plan(number)}
        plan = self._plans[number]
        node = int(np.argmin(np.sum((plan.centre - position[:2]) ** 2, axis=1)))
        station, facing = float(plan.station[node]), float(ahead[:2] @ plan.tangent[node])
        if self._stretch is not None and self._stretch.plan is plan and self._stretch.shows(station, facing):
            return plan
        stretch = Stretch.around(plan, self._choice.lining, station, facing)
        self._stretch = dataclasses.replace(stretch, texture=self._choice.texture)
        spec = stage_spec(self._stretch)
        if self._furnish is not None:
            self._furnish(spec, self._stretch)
        self._show(spec.compile())
        return plan

    def draw(
        self,
        target: Float[np.ndarray, "3"],
        lit: Float[np.ndarray, "3"],
        distance: float,
        azimuth: float,
        elevation: float,
        add: "Callable[[mujoco.MjvScene], None] | None" = None,
    ) -> np.ndarray:
        """Draw the present model, `(height, width, 3)` uint8.

        Args:
            target: Point that is looked at, m.
            lit: Point whose nearest lamps burn, m.
            distance: Distance of the camera from the target, m.
            azimuth: Direction that it looks to in plan, degrees.
            elevation: Its pitch, degrees.
            add: Adds to the scene what the model does not hold.

        Raises:
            PictureError: There is no OpenGL.
        """
        self._renderer = self._renderer or open_renderer(self.model, *self._size)
        light_near(self.model, self.data, lit)
        camera = self._mujoco.MjvCamera()
        camera.type, camera.lookat[:] = self._mujoco.mjtCamera.mjCAMERA_FREE, target
        camera.distance, camera.azimuth, camera.elevation = distance, azimuth, elevation
        self._renderer.update_scene(self.data, camera)
        if add is not None:
            add(self._renderer.scene)
        return self._renderer.render().copy()

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _show(self, model: "mujoco.MjModel") -> None:
        """Take another model; drawing must not change a solver's data, so it has data of its own."""
        self.close()
        self.model, self.data = model, self._mujoco.MjData(model)
        self._mujoco.mj_forward(model, self.data)
