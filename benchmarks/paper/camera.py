"""A picture of a scene from any place: `python -m benchmarks.paper.camera SCENE --at X Y Z --ahead X Y Z --out PNG`."""

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, UInt8
from PIL import Image

from benchmarks.paper.errors import PaperError
from benchmarks.render import light_up
from scene.arguments import parse

_BACKENDS = ("egl", "osmesa", "glfw")  # MuJoCo chooses its own when it is imported, hence the processes
_NAME = "paper"
_TIMEOUT = 300.0  # s


@dataclass(frozen=True)
class Pose:
    """Where an upright pinhole camera stands.

    Attributes:
        at: Tunnel frame, m, `(3,)`.
        ahead: Unit vector of its optical axis, not vertical, `(3,)`.
        fov: Vertical field of view, rad.
        width: Pixels.
        height: Pixels.
    """

    at: Float[np.ndarray, "3"]
    ahead: Float[np.ndarray, "3"]
    fov: float
    width: int
    height: int

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Rows: right, up and ahead, unit vectors in the tunnel frame."""
        right = np.cross(self.ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, self.ahead), self.ahead])

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * self.height / float(np.tan(0.5 * self.fov))


@dataclass(frozen=True)
class CameraConfig:
    """Renders a scene from a place of its own.

    Example: python -m benchmarks.paper.camera build/tunnel/scene.xml --at 5 0 1.5 --ahead 1 0 0 --out view.png

    Attributes:
        scene: MJCF file.
        at: Place in the tunnel frame, m.
        ahead: Where it looks; any length.
        fov_deg: Vertical field of view, degrees.
        width: Pixels.
        height: Pixels.
        out: PNG to write.
    """

    scene: tyro.conf.Positional[Path]
    at: tuple[float, float, float]
    ahead: tuple[float, float, float]
    fov_deg: float = 60.0
    width: int = 1200
    height: int = 900
    out: Path = Path("view.png")


def picture(scene: Path, pose: Pose) -> UInt8[np.ndarray, "height width 3"]:
    """What the camera sees.

    Raises:
        PaperError: MuJoCo can render with none of its OpenGL backends.
    """
    last = ""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "view.png"
        command = [sys.executable, "-m", "benchmarks.paper.camera", str(scene), "--out", str(out), *_words(pose)]
        wanted = os.environ.get("MUJOCO_GL")
        for backend in (wanted,) if wanted else _BACKENDS:
            environment = {**os.environ, "MUJOCO_GL": backend}
            try:
                done = subprocess.run(
                    command, env=environment, capture_output=True, text=True, timeout=_TIMEOUT, check=False
                )
            except subprocess.TimeoutExpired:
                last = f"{backend}: no picture within {_TIMEOUT:g} s"
                continue
            if done.returncode == 0 and out.exists():
                with Image.open(out) as image:
                    return np.asarray(image.convert("RGB"))
            last = (done.stderr.strip().splitlines() or [""])[-1]
    raise PaperError(f"{scene}: cannot be rendered, which figures 1 and 2 need ({last})")


def main(config: CameraConfig) -> None:
    """Renders once, with the backend that `MUJOCO_GL` names."""
    import mujoco

    ahead = np.array(config.ahead) / np.linalg.norm(config.ahead)
    pose = Pose(np.array(config.at), ahead, float(np.deg2rad(config.fov_deg)), config.width, config.height)
    spec = mujoco.MjSpec.from_file(str(config.scene))
    right, up, _ = pose.axes
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, up, -ahead], axis=1).ravel())  # MuJoCo's cameras look backwards
    spec.worldbody.add_camera(name=_NAME, pos=pose.at, quat=quaternion, fovy=config.fov_deg)
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
    vectors = ["--at", *map(repr, pose.at.tolist()), "--ahead", *map(repr, pose.ahead.tolist())]
    size = ["--width", str(pose.width), "--height", str(pose.height)]
    return [*vectors, "--fov-deg", repr(float(np.rad2deg(pose.fov))), *size]


if __name__ == "__main__":
    try:
        main(parse(lambda words: tyro.cli(CameraConfig, args=words, prog="python -m benchmarks.paper.camera")))
    except (OSError, ValueError) as fault:
        print(f"error: {fault}", file=sys.stderr)
        sys.exit(2)
