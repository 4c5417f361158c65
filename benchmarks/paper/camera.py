"""Renders a scene from any place: `python -m benchmarks.paper.camera SCENE --at X Y Z --ahead X Y Z --out PNG`."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, UInt8
from PIL import Image

from benchmarks.command import BenchmarkError, run_main
from benchmarks.draw.scene import BACKENDS, light_up, render_in_subprocess

_NAME = "paper"
_TIMEOUT = 300.0  # s


@dataclass(frozen=True)
class Pose:
    """Pose and size of an upright pinhole camera.

    Attributes:
        position: Position in the tunnel frame, m, `(3,)`.
        ahead: Unit vector of its optical axis, not vertical, `(3,)`.
        fov: Vertical field of view, rad.
        width: Width, pixels.
        height: Height, pixels.
    """

    position: Float[np.ndarray, "3"]
    ahead: Float[np.ndarray, "3"]
    fov: float
    width: int
    height: int

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Unit vectors to the right, up and ahead in the tunnel frame, as rows."""
        right = np.cross(self.ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, self.ahead), self.ahead])

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * self.height / float(np.tan(0.5 * self.fov))


@dataclass(frozen=True)
class CameraConfig:
    """Renders a scene from any place.

    Example: python -m benchmarks.paper.camera build/tunnel/scene.xml --at 5 0 1.5 --ahead 1 0 0 --out view.png

    Attributes:
        scene: MJCF file.
        at: Position in the tunnel frame, m.
        ahead: Viewing direction; any length.
        fov_deg: Vertical field of view, degrees.
        width: Width, pixels.
        height: Height, pixels.
        out: PNG file to write.
    """

    scene: tyro.conf.Positional[Path]
    at: tuple[float, float, float]
    ahead: tuple[float, float, float]
    fov_deg: float = 60.0
    width: int = 1200
    height: int = 900
    out: Path = Path("view.png")


def picture(scene: Path, pose: Pose) -> UInt8[np.ndarray, "height width 3"]:
    """Renders a scene from a pose.

    Raises:
        BenchmarkError: MuJoCo can render with none of its OpenGL backends.
    """
    chosen = os.environ.get("MUJOCO_GL")
    words = ["benchmarks.paper.camera", str(scene), *_words(pose)]
    view, reason = render_in_subprocess(words, (chosen,) if chosen else BACKENDS, _TIMEOUT)
    if view is None:
        raise BenchmarkError(f"{scene}: cannot be rendered, which figures 1 and 2 need ({reason})")
    return view


def main(config: CameraConfig) -> None:
    """Renders once, with the backend that `MUJOCO_GL` names."""
    import mujoco

    ahead = np.array(config.ahead) / np.linalg.norm(config.ahead)
    pose = Pose(np.array(config.at), ahead, float(np.deg2rad(config.fov_deg)), config.width, config.height)
    spec = mujoco.MjSpec.from_file(str(config.scene))
    right, up, _ = pose.axes
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, up, -ahead], axis=1).ravel())  # MuJoCo's cameras look backwards
    spec.worldbody.add_camera(name=_NAME, pos=pose.position, quat=quaternion, fovy=config.fov_deg)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = config.width, config.height
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    light_up(model, data, _NAME)
    renderer = mujoco.Renderer(model, config.height, config.width)
    renderer.update_scene(data, camera=_NAME)
    Image.fromarray(renderer.render()).save(config.out)
    renderer.close()


def _words(pose: Pose) -> list[str]:
    vectors = ["--at", *map(repr, pose.position.tolist()), "--ahead", *map(repr, pose.ahead.tolist())]
    size = ["--width", str(pose.width), "--height", str(pose.height)]
    return [*vectors, "--fov-deg", repr(float(np.rad2deg(pose.fov))), *size]


if __name__ == "__main__":
    sys.exit(run_main("paper.camera", CameraConfig, main))
