"""MCAP files of any profile: the library's reader takes those of ROS2 alone, although the format is the same.

Source: MCAP specification, "Header", "Schema"; well-known profiles `ros1` and `ros2`, an empty one for any other
writer, and well-known encodings `ros1msg`, `ros2msg` (schemas), `ros1`, `cdr` (messages).
"""

from pathlib import Path
from typing import IO, Any

from rosbags.rosbag2 import Reader

_CONTENT = 17  # byte after magic, opcode and length of the header record; its two strings take 8 bytes or more
_ROS2 = b"\x04\0\0\0ros2"
_KNOWN_SCHEMAS = ("ros2msg", "ros2idl", "omgidl", "")


def open_mcap(path: Path) -> Any:
    """The library's reader of a file, opened, with types named as ROS2 names them.

    Raises:
        Exception: Whatever the library raises on damage.
    """
    reader: Any = Reader.STORAGE_PLUGINS[".mcap"](_AnyProfile(path))  # type: ignore[arg-type]
    reader.schemas = _Schemas()
    reader.open()
    return reader


def is_ros1(connection: Any) -> bool:
    """Whether the messages of a connection are serialised as ROS1 does."""
    return getattr(connection.ext, "serialization_format", "") == "ros1"


class _AnyProfile:
    """A path whose file says that its profile is ROS2."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __str__(self) -> str:
        return str(self._path)

    def open(self, mode: str) -> "_Ros2Header":
        return _Ros2Header(self._path.open(mode))


class _Ros2Header:
    """A file with the first eight bytes of its header record replaced; nothing behind them is read by position."""

    def __init__(self, file: IO[Any]) -> None:
        self._file = file
        self.seek, self.tell, self.close = file.seek, file.tell, file.close

    def read(self, size: int = -1) -> bytes:
        start = self._file.tell()
        data = self._file.read(size)
        if start >= _CONTENT + len(_ROS2) or start + len(data) <= _CONTENT:
            return data
        patched = bytearray(data)
        for place, byte in enumerate(_ROS2, _CONTENT - start):
            if 0 <= place < len(data):
                patched[place] = byte
        return bytes(patched)


class _Schemas(dict[int, Any]):
    """Schemas by number; of those in a language that the library does not know, the name alone is kept."""

    def __setitem__(self, key: int, schema: Any) -> None:
        package, _, kind = schema.name.partition("/")
        name = f"{package}/msg/{kind}" if kind and "/" not in kind else schema.name
        known = schema.encoding in _KNOWN_SCHEMAS
        super().__setitem__(
            key, schema._replace(name=name) if known else schema._replace(name=name, encoding="", data="")
        )
