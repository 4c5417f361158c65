"""The connected browsers: what they may send, where their cameras stand, and the pictures that they draw.

viser sets any attribute that a message names, and opens a tunnel to the internet for anyone who asks for a link to
share. Such messages are dropped here. Pages of other sites in the same browser may not press buttons either. Written
against viser 1.1.
"""

import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import imageio.v3 as imageio
import numpy as np
import viser
from jaxtyping import Float
from viser import _messages as messages

from subterra_jax.host.files import replace_file
from subterra_jax.viewer.config import ViewerError
from subterra_jax.viewer.geometry import Centreline, Moment

CHASE, ABOVE, MAP, FREE = MODES = ("chase", "from above", "map", "free")
_FOV = np.deg2rad(60.0)


def camera_pose(
    mode: str, centreline: Centreline, moment: Moment | None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    """Return the camera's position and the point it looks at, m; `None` for a free camera.

    Args:
        mode: One of `MODES`.
        centreline: The tunnel.
        moment: Moment of the episode; `None` before the first: the start of the tunnel.
    """
    if mode == FREE:
        return None
    if mode == MAP:
        return _map(centreline)
    position, facing = _robot(centreline, moment)
    up = np.array([0.0, 0.0, 1.0])
    if mode == CHASE:
        return position - 3.6 * facing + 1.9 * up, position + 3.0 * facing + 0.7 * up
    left = np.cross(up, facing)
    return position - 8.0 * facing - 5.0 * left + 9.0 * up, position + 2.0 * facing


def move_camera(client: viser.ClientHandle, at: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> None:
    """Move one browser's camera; do nothing if the browser has sent malformed camera data."""
    try:
        with client.atomic():
            client.camera.position = at
            client.camera.look_at = target
    except (TypeError, ValueError, AssertionError):
        return


def _robot(centreline: Centreline, moment: Moment | None) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    if moment is not None:
        return moment.position, np.array([np.cos(moment.heading), np.sin(moment.heading), 0.0])
    zero = np.zeros(1)
    return centreline.points_at(zero, zero)[0], np.array([*centreline.plan.tangent[0], 0.0])


def _map(centreline: Centreline) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return a camera above the middle, high enough to see both ends, a little from the south so that north is up."""
    low, high = centreline.plan.centre.min(axis=0), centreline.plan.centre.max(axis=0)
    middle = np.array([*(0.5 * (low + high)), float(np.mean(centreline.plan.elevation))])
    height = 0.62 * max(high[0] - low[0], 1.6 * (high[1] - low[1]), 30.0) / np.tan(0.5 * _FOV)
    return middle + np.array([0.0, -0.15 * height, height]), middle


_REFUSED = (
    messages.ShareUrlRequest,
    messages.ShareUrlDisconnect,
    messages.FileTransferStartUpload,
    messages.FileTransferPart,
    messages.GuiFormSubmitMessage,
    messages.GuiFormDirtyMessage,
    messages.CommandTriggerMessage,
    messages.GuiButtonHoldMessage,
)


def restrict_messages(server: viser.ViserServer) -> None:
    """Let only valid values of controls through to a server."""
    inner: Callable[..., Any] = server.gui._handle_gui_updates
    link = server._websock_server
    for kind in _REFUSED:
        if kind in link._incoming_handlers:
            link.unregister_handler(kind)
    link.unregister_handler(messages.GuiUpdateMessage)

    async def pass_valid(client_id: Any, message: messages.GuiUpdateMessage) -> None:
        uuid, updates = message.uuid, message.updates
        handle = server.gui._gui_input_handle_from_uuid.get(uuid) if isinstance(uuid, str) else None
        if handle is not None and isinstance(updates, dict) and is_valid(handle, updates):
            await inner(client_id, message)

    link.register_handler(messages.GuiUpdateMessage, pass_valid)

    async def close_foreign(client: Any) -> None:
        connection = link._live_connections[client.client_id]
        if connection.request is None or not is_own_page(connection.request.headers):
            await connection.close(1008, "this page may not use the viewer")

    link.on_client_connect(close_foreign)


def is_own_page(headers: Mapping[str, str]) -> bool:
    """Return whether a websocket was opened by a page of this server, or by no page at all."""
    origin = headers.get("Origin")
    return origin is None or urlsplit(origin).netloc == headers.get("Host")


def is_valid(handle: Any, updates: dict[str, Any]) -> bool:
    """Return whether updates hold one value that a control can take: its kind, its options, its bounds."""
    if set(updates) != {"value"} or not handle.visible or getattr(handle, "disabled", False):
        return False
    value, present = updates["value"], handle._impl.value
    if isinstance(present, bool):
        return isinstance(value, bool)
    if isinstance(present, str):
        options = getattr(handle, "options", None)
        return isinstance(value, str) and (options is None or value in options) and len(value) <= 200
    if isinstance(present, int | float):
        return _is_number(value) and _in_bounds(handle, float(value))
    return False


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _in_bounds(handle: Any, value: float) -> bool:
    low, high = (getattr(handle, name, None) for name in ("min", "max"))
    return (low is None or value >= low - 1e-9) and (high is None or value <= high + 1e-9)


_LARGEST = 4096  # pixels on a side
_TIMEOUT = 20.0  # s


def save_picture(client: viser.ClientHandle, path: Path) -> None:
    """Let a browser render its view, write it to a PNG, and offer it to the browser as a download.

    Raises:
        ViewerError: The browser sent no picture.
        OutputError: The file cannot be written.
    """
    camera = client.camera
    try:
        height, width = (min(max(int(side), 16), _LARGEST) for side in (camera.image_height, camera.image_width))
        pixels = client.get_render(height, width, transport_format="jpeg", timeout=_TIMEOUT)
    except (RuntimeError, TimeoutError, TypeError, ValueError, AssertionError) as error:
        raise ViewerError(f"the browser gave no picture ({error})") from error
    buffer = io.BytesIO()
    imageio.imwrite(buffer, pixels[..., :3], extension=".png")
    with replace_file(path) as partial:
        partial.write_bytes(buffer.getvalue())
    client.send_file_download(path.name, buffer.getvalue())
