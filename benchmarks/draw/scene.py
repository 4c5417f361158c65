"""Renders a scene off screen: `python -m benchmarks.draw scene SCENE --out PNG`."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

from benchmarks.command import run_main
from subterra_jax.host.files import require_file

# MuJoCo chooses its OpenGL backend when it is imported, so each is tried in a process of its own.
BACKENDS = ("egl", "osmesa", "glfw")
_TIMEOUT = 120.0  # s
_LIT = 7  # OpenGL lights a scene with eight lights, the headlight among them
_MOST_PIXELS = 8192
_LOOK_AHEAD = 8.0  # m


@dataclass(frozen=True)
class RenderConfig:
    """Renders a scene as one of its cameras sees it.

    Example: python -m benchmarks.draw scene build/tunnel --camera chase --out view.png

    Attributes:
        scene: Scene folder, or an MJCF file.
        out: PNG file to write.
        camera: Camera of the scene: scout, chase, portal_start, middle, wall or portal_end.
        width: Width, pixels.
        height: Height, pixels.
    """

    scene: tyro.conf.Positional[Path]
    out: Path = Path("view.png")
    camera: str = "scout"
    width: int = 960
    height: int = 540


def picture(scene: Path) -> np.ndarray | None:
    """Renders a view down the bore, `(height, width, 3)` uint8; `None` where no OpenGL backend works."""
    return render_in_subprocess(["benchmarks.draw", "scene", str(scene)], BACKENDS, _TIMEOUT)[0]


def render_in_subprocess(
    words: Sequence[str], backends: Sequence[str], timeout: float
) -> tuple[np.ndarray | None, str]:
    """Runs a rendering command with one OpenGL backend after another until one leaves a picture.

    Args:
        words: Words after `python -m`; `--out` is added.
        backends: Values of `MUJOCO_GL` to try.
        timeout: Time limit of each try, s.

    Returns:
        The picture, `(height, width, 3)` uint8, or `None`; and why the last backend failed.
    """
    reason = ""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "view.png"
        command = [sys.executable, "-m", *words, "--out", str(out)]
        for backend in backends:
            environment = {**os.environ, "MUJOCO_GL": backend}
            try:
                done = subprocess.run(
                    command, env=environment, capture_output=True, text=True, timeout=timeout, check=False
                )
            except subprocess.TimeoutExpired:
                reason = f"{backend}: no picture within {timeout:g} s"
                continue
            if done.returncode == 0 and out.exists():
                with Image.open(out) as image:
                    return np.asarray(image.convert("RGB")), ""
            reason = (done.stderr.strip().splitlines() or [""])[-1]
    return None, reason


def light_up(model: Any, data: Any, camera: str) -> None:
    """Switches on the lamps nearest to a camera's view and all others off, since OpenGL allows only a few.

    Args:
        model: An `MjModel`.
        data: Its `MjData`, after `mj_forward`.
        camera: Name of the camera.
    """
    eye = model.camera(camera).id
    ahead = data.cam_xpos[eye] - _LOOK_AHEAD * data.cam_xmat[eye].reshape(3, 3)[:, 2]
    nearest = np.argsort(np.linalg.norm(data.light_xpos - ahead, axis=1))[:_LIT]
    model.light_active[:] = False
    model.light_active[nearest] = True


def render(config: RenderConfig) -> None:
    """Renders once, with the backend that `MUJOCO_GL` names."""
    import mujoco

    path = config.scene / "scene.xml" if config.scene.is_dir() else config.scene
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    light_up(model, data, config.camera)
    renderer = mujoco.Renderer(model, config.height, config.width)
    renderer.update_scene(data, camera=config.camera)
    Image.fromarray(renderer.render()).save(config.out)
    renderer.close()


def check_and_render(config: RenderConfig) -> None:
    """Checks the settings, then renders.

    Raises:
        ValueError: A number is out of range, or MuJoCo cannot render the scene.
        SubterraError: The picture cannot be written.
    """
    import mujoco

    for name in ("width", "height"):
        if not 1 <= getattr(config, name) <= _MOST_PIXELS:
            raise ValueError(f"{name} must be 1 to {_MOST_PIXELS}, got {getattr(config, name)}")
    require_file(config.out, ".png")
    try:
        render(config)
    except (OSError, ValueError, KeyError, mujoco.FatalError) as fault:
        raise ValueError(f"{config.scene}: {fault}") from fault


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("draw scene", RenderConfig, check_and_render, words=words)
