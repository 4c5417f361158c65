"""Pictures for the scene's materials, made from noise: segments of concrete, and ballast."""

import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

_SEGMENTS = 6  # of a ring
_STONES = 900


def write_png(path: Path, picture: UInt8[np.ndarray, "height width 3"]) -> None:
    """Writes an RGB picture as PNG."""
    height, width, _ = picture.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), picture.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def concrete(rings: bool, height: int = 512, width: int = 2048) -> UInt8[np.ndarray, "height width 3"]:
    """One turn of a lining to the right, two rings upwards, with staggered joints of segments where there are rings."""
    shade = 0.62 + 0.020 * _noise((height, width), (1.0, 1.0), 0) + 0.030 * _noise((height, width), (24.0, 30.0), 1)
    shade += 0.030 * _noise((height, width), (5.0, 90.0), 2)  # what water leaves on its way down
    if rings:
        v, u = np.arange(height)[:, None] / height, np.arange(width)[None, :] / width
        ring = (v * 2).astype(int)
        tone = 0.02 * np.random.default_rng(3).standard_normal((2, _SEGMENTS))
        place = u * _SEGMENTS + 0.5 * ring
        shade += tone[ring, place.astype(int) % _SEGMENTS]
        across = np.abs((v * 2 + 0.5) % 1 - 0.5) * height / 2
        along = np.abs((place + 0.5) % 1 - 0.5) * width / _SEGMENTS
        joint = np.minimum(across + 0 * along, along * 2)
        shade -= 0.25 * np.exp(-((joint / 2.5) ** 2)) + 0.06 * np.exp(-((joint / 12.0) ** 2))
    return _tinted(shade, (1.0, 0.985, 0.95))


def ballast(size: int = 512) -> UInt8[np.ndarray, "size size 3"]:
    """Broken stone seen from above, repeating at its edges."""
    rng = np.random.default_rng(4)
    stone = rng.random((_STONES, 2))
    tone = 0.40 + 0.09 * rng.standard_normal(_STONES)
    pixel = (np.indices((size, size)).reshape(2, -1).T + 0.5) / size
    distance, nearest = cKDTree(stone, boxsize=1.0).query(pixel, 2)
    edge = np.clip((distance[:, 1] - distance[:, 0]) * size / 9.0, 0.0, 1.0)
    tilt = ((pixel - stone[nearest[:, 0]] + 0.5) % 1 - 0.5) @ [1.0, 0.6] * 3.0
    shade = (tone[nearest[:, 0]] + tilt) * (0.35 + 0.65 * edge)
    return _tinted(shade.reshape(size, size), (1.0, 0.96, 0.91))


def _noise(shape: tuple[int, int], sigma: tuple[float, float], seed: int) -> Float[np.ndarray, "height width"]:
    """Smoothed noise of unit variance that repeats at the edges."""
    white = np.fft.rfft2(np.random.default_rng(seed).standard_normal(shape))
    v, u = np.fft.fftfreq(shape[0])[:, None] * sigma[0], np.fft.rfftfreq(shape[1])[None, :] * sigma[1]
    field = np.fft.irfft2(white * np.exp(-2 * np.pi**2 * (v**2 + u**2)), shape)
    return field / field.std()


def _tinted(shade: np.ndarray, tint: tuple[float, float, float]) -> np.ndarray:
    return np.clip(255 * shade[..., None] * np.array(tint), 0, 255).astype(np.uint8)
