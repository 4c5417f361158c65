"""Files of a survey, each written under a temporary name and renamed."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float, Shaped

from scene.survey.mesh import Mesh
from scene.survey.messages import EPOCH

CLOUD_POINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4")])


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary name beside `path`, and rename to `path` if all went well; otherwise leave nothing behind."""
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON on one line."""
    with replacing(path) as part:
        part.write_text(json.dumps(content, allow_nan=False) + "\n")


def write_yaml(path: Path, content: dict[str, Any]) -> None:
    """Write YAML, lists of numbers on one line."""
    with replacing(path) as part:
        part.write_text(yaml.safe_dump(content, default_flow_style=None, sort_keys=False, width=120))


def write_tum(
    path: Path,
    time: Float[np.ndarray, "n"],
    position: Float[np.ndarray, "n 3"],
    quaternion: Float[np.ndarray, "n 4"] | None,
) -> None:
    """Write rows of `t x y z qx qy qz qw`; the quaternion is all zero where there is none.

    Args:
        path: File to write.
        time: s since the start of the survey.
        position: m.
        quaternion: x, y, z, w, or None.
    """
    turns = np.zeros((len(time), 4)) if quaternion is None else quaternion
    with replacing(path) as part, part.open("w") as file:
        for t, p, q in zip(time, position, turns, strict=True):
            # Seconds and fraction apart: together they would exceed what a float64 resolves.
            whole, micro = divmod(round(t * 1e6), 1_000_000)
            row = [f"{EPOCH + whole}.{micro:06d}", *(f"{v:.6f}" for v in p), *(f"{v:.9f}" for v in q)]
            file.write(" ".join(row) + "\n")


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY in float64, with the `part` of each triangle."""
    faces = np.empty(len(mesh.faces), [("n", "u1"), ("v", "<i4", 3), ("part", "u1")])
    faces["n"], faces["v"], faces["part"] = 3, mesh.faces, mesh.part
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment simulated\n"
        f"element vertex {len(mesh.vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty uchar part\nend_header\n"
    )
    with replacing(path) as part, part.open("wb") as file:
        file.write(header.encode())
        file.write(mesh.vertices.astype("<f8").tobytes())
        file.write(faces.tobytes())


class CloudWriter:
    """Writes returns in the survey frame, float64, to a binary PLY, and a binary PCD if asked, as they come."""

    def __init__(self, ply: Path, pcd: Path | None = None) -> None:
        self._files = [(ply.open("wb"), _ply_header)]
        if pcd is not None:
            self._files.append((pcd.open("wb"), _pcd_header))
        self._count = 0
        self._write_headers()

    def _write_headers(self) -> None:
        for file, header in self._files:
            file.seek(0)
            file.write(header(self._count))

    def add(self, placed: Float[np.ndarray, "n 3"], intensity: Shaped[np.ndarray, "n"]) -> None:
        """Append points, m, in the survey frame."""
        points = np.empty(len(placed), CLOUD_POINT)
        points["x"], points["y"], points["z"] = placed.T
        points["intensity"] = intensity
        self._count += len(points)
        for file, _ in self._files:
            file.write(points.tobytes())

    def __enter__(self) -> "CloudWriter":
        """Return the writer, open."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the final counts into the headers and close."""
        self._write_headers()
        for file, _ in self._files:
            file.close()


def _ply_header(count: int) -> bytes:
    # Blanks after the count would break strict readers, so a comment takes up the slack.
    pad = "x" * (12 - len(str(count)))
    return (
        f"ply\nformat binary_little_endian 1.0\ncomment simulated {pad}\nelement vertex {count}\n"
        "property double x\nproperty double y\nproperty double z\nproperty float intensity\nend_header\n"
    ).encode()


def _pcd_header(count: int) -> bytes:
    pad = "x" * (24 - 2 * len(str(count)))
    return (
        f"# .PCD v0.7 - simulated {pad}\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 8 8 8 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    ).encode()
