"""Renders a scene off screen: `python -m benchmarks.draw scene SCENE --out PNG`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, UInt8
from PIL import Image

from benchmarks.command import BenchmarkError, require_least
from subterra_jax.host.files import replace_file, require_file
from subterra_jax.pictures.renderer import import_mujoco, light_near, open_renderer

_LOOK_AHEAD = 8.0  # m
_OWN = "own"  # name of a camera that the scene does not have

Picture = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Pose:
    """Pose and size of an upright pinhole camera."""

    position: Float[np.ndarray, "3"]  # Position in the tunnel frame, m
    ahead: Float[np.ndarray, "3"]  # Unit vector of its optical axis, not vertical
    fov: float  # Vertical field of view, rad
    width: int  # Width, pixels
    height: int  # Height, pixels

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Unit vectors to the right, up and ahead in the tunnel frame, as rows."""
        right = np.cross(self.ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, self.ahead), self.ahead])


@dataclass(frozen=True)
class RenderConfig:
    """Renders a scene as one of its cameras, or a camera anywhere, sees it.

    Example: python -m benchmarks.draw scene build/tunnel --camera chase --out view.png
    """

    scene: tyro.conf.Positional[Path]  # Scene folder, or an MJCF file.
    out: Path = Path("view.png")  # PNG file to write.
    camera: str = "scout"  # Camera of the scene: scout, chase, portal_start, middle, wall or portal_end.
    at: tuple[float, float, float] | None = None  # Position of a camera of your own in place of it, tunnel frame, m.
    ahead: tuple[float, float, float] = (1.0, 0.0, 0.0)  # Its viewing direction, of any length.
    fov_deg: float = 60.0  # Its vertical field of view, degrees.
    width: int = 960  # Width, 1 to 8192 pixels.
    height: int = 540  # Height, 1 to 8192 pixels.


def picture(scene: Path, camera: str | Pose, width: int = 960, height: int = 540) -> Picture:
    """Renders a scene folder, or an MJCF file, as one of its cameras, or a camera anywhere, sees it.

    Raises:
        BenchmarkError: MuJoCo cannot read the scene, or it has no such camera.
        PictureError: There is no OpenGL.
    """
    mujoco = import_mujoco("pictures of a scene")
    name = camera if isinstance(camera, str) else _OWN
    try:
        spec = mujoco.MjSpec.from_file(str(scene / "scene.xml" if scene.is_dir() else scene))
        if isinstance(camera, Pose):
            width, height = camera.width, camera.height
            right, up, ahead = camera.axes
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, np.stack([right, up, -ahead], axis=1).ravel())  # cameras look backwards
            fov_deg = np.rad2deg(camera.fov)
            spec.worldbody.add_camera(name=_OWN, pos=camera.position, quat=quaternion, fovy=fov_deg)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        eye = model.camera(name).id
    except (OSError, ValueError, KeyError, mujoco.FatalError) as fault:
        raise BenchmarkError(f"{scene}: {fault}") from fault
    light_near(model, data, data.cam_xpos[eye] - _LOOK_AHEAD * data.cam_xmat[eye].reshape(3, 3)[:, 2])
    renderer = open_renderer(model, width, height)
    renderer.update_scene(data, camera=name)
    pixels: Picture = renderer.render().copy()
    renderer.close()
    return pixels


def run(config: RenderConfig) -> None:
    """Checks the settings, renders, and writes the picture.

    Raises:
        SubterraError: A number is out of range, MuJoCo cannot render the scene, or the picture cannot be written.
    """
    require_least(config, width=1, height=1)
    if max(config.width, config.height) > 8192:
        raise BenchmarkError(f"width and height must be at most 8192, got {config.width} x {config.height}")
    require_file(config.out, ".png")
    camera: str | Pose = config.camera
    if config.at is not None:
        ahead = np.array(config.ahead) / max(float(np.linalg.norm(config.ahead)), 1e-9)
        camera = Pose(np.array(config.at), ahead, float(np.deg2rad(config.fov_deg)), config.width, config.height)
    pixels = picture(config.scene, camera, config.width, config.height)
    with replace_file(config.out) as path:
        Image.fromarray(pixels).save(path, format="PNG")
