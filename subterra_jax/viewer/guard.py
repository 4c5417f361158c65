"""What a browser may say to the server: a new value of a control, of the right kind and within its bounds.

viser sets whatever attribute a message names, and would open a tunnel to the internet for anyone who asks for a link to
share. Everything of that kind is dropped here. Nor may other people's pages, open in the same browser, press buttons.
Written against viser 1.1.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

import viser
from viser import _messages as messages

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


def harden(server: viser.ViserServer) -> None:
    """Lets nothing through to a server but sound values of its controls."""
    inner: Callable[..., Any] = server.gui._handle_gui_updates
    link = server._websock_server
    for kind in _REFUSED:
        if kind in link._incoming_handlers:
            link.unregister_handler(kind)
    link.unregister_handler(messages.GuiUpdateMessage)

    async def checked(client_id: Any, message: messages.GuiUpdateMessage) -> None:
        uuid, updates = message.uuid, message.updates
        handle = server.gui._gui_input_handle_from_uuid.get(uuid) if isinstance(uuid, str) else None
        if handle is not None and isinstance(updates, dict) and sound(handle, updates):
            await inner(client_id, message)

    link.register_handler(messages.GuiUpdateMessage, checked)

    async def own_page_only(client: Any) -> None:
        connection = link._live_connections[client.client_id]
        if connection.request is None or not same_place(connection.request.headers):
            await connection.close(1008, "this page may not use the viewer")

    link.on_client_connect(own_page_only)


def same_place(headers: Mapping[str, str]) -> bool:
    """Whether a websocket is opened by the page that came from here, or by no page at all."""
    origin = headers.get("Origin")
    return origin is None or urlsplit(origin).netloc == headers.get("Host")


def sound(handle: Any, updates: dict[str, Any]) -> bool:
    """Whether updates hold one new value that a control can take: of its kind, among its options, within its bounds."""
    if set(updates) != {"value"} or not handle.visible or getattr(handle, "disabled", False):
        return False
    value, present = updates["value"], handle._impl.value
    if isinstance(present, bool):
        return isinstance(value, bool)
    if isinstance(present, str):
        options = getattr(handle, "options", None)
        return isinstance(value, str) and (options is None or value in options) and len(value) <= 200
    if isinstance(present, int | float):
        return _number(value) and _within(handle, float(value))
    return False


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _within(handle: Any, value: float) -> bool:
    low, high = (getattr(handle, name, None) for name in ("min", "max"))
    return (low is None or value >= low - 1e-9) and (high is None or value <= high + 1e-9)
