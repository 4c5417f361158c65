"""A browser without a browser: the websocket of the viewer's page."""

import msgspec.msgpack
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 1.0, 1.0],
    "fov": 1.0,
    "image_height": 480,
    "image_width": 640,
    "near": 0.01,
    "far": 1000.0,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


def join(url: str, page: str | None = None) -> ClientConnection:
    """Connects as the page does, or as a page from elsewhere."""
    link = connect(
        url.replace("http", "ws"),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        origin=Origin(page or url),
        compression=None,
        max_size=None,
    )
    say(link, _CAMERA)
    return link


def say(link: ClientConnection, message: object) -> None:
    """Sends a message as the page does."""
    link.send(msgspec.msgpack.encode(message))


def heard(link: ClientConnection, timeout: float) -> list[dict]:
    """The messages of the next window; raises `TimeoutError` where none comes."""
    raw = link.recv(timeout=timeout)
    assert isinstance(raw, bytes)
    size = int.from_bytes(raw[8:16], "little")
    return msgspec.msgpack.decode(zstandard.decompress(raw[16 : 16 + size]))["messages"]
