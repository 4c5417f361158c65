"""MuJoCo's off-screen renderer: opened with one clear sentence where it cannot be, and closed before Python ends."""

from __future__ import annotations

import atexit
import os
import sys
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np

from subterra_jax.host.errors import MissingLibraryError, SubterraError

if TYPE_CHECKING:
    import mujoco

MOST_LAMPS = 7  # OpenGL lights a scene with eight lights, the headlight among them


class PictureError(SubterraError):
    """MuJoCo cannot draw here."""


def choose_gl() -> None:
    """Have MuJoCo draw with EGL where there is no display: it reads `MUJOCO_GL` once, at its import."""
    if sys.platform == "linux" and "mujoco" not in sys.modules and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")


def import_mujoco(purpose: str) -> Any:
    """Import MuJoCo after `choose_gl`.

    Raises:
        MissingLibraryError: MuJoCo is not installed.
    """
    choose_gl()
    try:
        import mujoco
    except ImportError as missing:
        raise MissingLibraryError(purpose, "mujoco") from missing
    return mujoco


_OPEN: weakref.WeakSet[Any] = weakref.WeakSet()


def open_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """Open a renderer; whoever does not close it has it closed when Python ends, while there still is an OpenGL.

    Raises:
        PictureError: There is no OpenGL.
    """
    import mujoco

    frame = model.vis.global_
    frame.offwidth, frame.offheight = max(frame.offwidth, width), max(frame.offheight, height)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except (RuntimeError, AttributeError, ImportError, mujoco.FatalError) as cause:
        raise PictureError(
            f"MuJoCo cannot draw with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}: {cause}; set it to egl, "
            "osmesa or glfw before anything imports mujoco"
        ) from cause
    _OPEN.add(renderer)
    # What is registered last runs first: before the end of OpenGL, which MuJoCo registers with its first context.
    atexit.unregister(close_all)
    atexit.register(close_all)
    return renderer


def close_all() -> None:
    """Close every renderer that is still open: at exit MuJoCo's own clean-up comes after OpenGL is gone."""
    for renderer in list(_OPEN):
        renderer.close()
    _OPEN.clear()


def light_near(model: mujoco.MjModel, data: mujoco.MjData, point: np.ndarray) -> None:
    """Switch on the lamps nearest to a point, m, and the others off."""
    away = np.linalg.norm(data.light_xpos - point, axis=1)
    if len(away):
        model.light_active[:] = away <= np.sort(away)[min(MOST_LAMPS, len(away)) - 1]
