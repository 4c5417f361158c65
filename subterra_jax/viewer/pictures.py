"""What a browser shows, as a PNG."""

import io
import os
from pathlib import Path

import imageio.v3 as imageio
import viser

from subterra_jax.viewer.errors import ViewerError

_LARGEST = 4096  # pixels on a side
_PATIENCE = 20.0  # s


def save_picture(client: viser.ClientHandle, path: Path) -> None:
    """Has a browser draw what it shows, writes that to a file, and hands it to the browser as a download too.

    Args:
        client: The browser.
        path: Where the PNG goes.

    Raises:
        ViewerError: The browser has no picture, or the file cannot be written.
    """
    camera = client.camera
    try:
        height, width = (min(max(int(side), 16), _LARGEST) for side in (camera.image_height, camera.image_width))
        pixels = client.get_render(height, width, transport_format="jpeg", timeout=_PATIENCE)
    except (RuntimeError, TimeoutError, TypeError, ValueError, AssertionError) as error:
        raise ViewerError(f"the browser gave no picture ({error})") from error
    buffer = io.BytesIO()
    imageio.imwrite(buffer, pixels[..., :3], extension=".png")
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(buffer.getvalue())
        os.replace(partial, path)
    except OSError as error:
        raise ViewerError(f"{path}: cannot be written ({error.strerror})") from error
    client.send_file_download(path.name, buffer.getvalue())
