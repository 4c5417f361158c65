"""Draws the wall of each kind unrolled, as a LiDAR reads its intensities and as a picture shows it.

`python -m benchmarks.draw walls --out docs/walls.png`
"""

import io
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import subterra_jax as st
from benchmarks.results import png_bytes, write_file
from subterra_jax.evaluation.localisability import look_along
from subterra_jax.host.texture import brightness, check_dial, wall_angle
from subterra_jax.procedural.kinds import KINDS
from subterra_jax.procedural.open_world import HELD_OUT, UNSEEN, plan

_BEGIN, _END, _STEP = 14.0, 26.0, 0.25  # m: wall that is drawn; distance between two scans
_CELLS = (240, 176)  # along, around
_EXTENT = (_BEGIN, _END, -180.0, 180.0)
_GREYS = 12  # of a picture, to keep it small


@dataclass(frozen=True)
class WallsConfig:
    """Settings of the picture."""

    out: Path = Path("out/walls.png")  # File to write.
    texture: float = 1.0  # Brightness of the walls, from 0 to 1.
    index: int = 900_010  # Index of the tunnel in its split, behind every one that results are made with.


def run(config: WallsConfig) -> None:
    """Draws the picture."""
    check_dial(config.texture)
    figure, axes = plt.subplots(len(KINDS), 2, figsize=(9.0, 1.5 * len(KINDS)), layout="constrained", sharex=True)
    for kind, row in zip(KINDS, axes, strict=True):
        name = f"open:{kind}:{'train' if kind in HELD_OUT else UNSEEN}:{config.index}"
        tunnel = plan(name, variants=("bare",), length=40.0)
        seed = tunnel.texture or 0
        station, turn = np.linspace(_BEGIN, _END, _CELLS[0]), np.linspace(-np.pi, np.pi, _CELLS[1])
        drawn = np.log(brightness(np, station[None], turn[:, None], seed, config.texture))
        for panel, picture in zip(row, (read(tunnel, config.texture), drawn), strict=True):
            panel.imshow(picture, cmap="gray", vmin=-0.8, vmax=0.6, aspect="auto", origin="lower", extent=_EXTENT)
            panel.set_yticks([-90, 0, 90], ["right", "crown", "left"])
        row[0].set_ylabel(kind)
    axes[0, 0].set_title("intensities of a VLP-16, incidence taken out")
    axes[0, 1].set_title("brightness of the lining")
    axes[-1, 0].set_xlabel("station, m")
    axes[-1, 1].set_xlabel("station, m")
    small = io.BytesIO()
    Image.open(io.BytesIO(png_bytes(figure, dpi=70))).convert("L").quantize(_GREYS).save(small, "png", optimize=True)
    write_file(config.out, small.getvalue())


def read(tunnel: st.TunnelPlan, texture: float) -> np.ndarray:
    """Returns the wall unrolled, `(around, along)`: logarithms beside the mean of each angle, NaN where unseen."""
    env, params = st.make("Subterra/TraverseShort-v1", tunnel=tunnel, sensor="vlp16", intensity=True, texture=texture)
    places = np.arange(_BEGIN - 3.0, _END + 3.0, _STEP)
    seen = look_along(env, params, jnp.asarray(places[:, None], jnp.float32), 0)
    scan, shown = (np.asarray(seen[name], float)[:, 0] for name in ("scan", "intensity"))
    ends = np.asarray(params.lidar.directions, float) * scan[..., None]
    along = places[:, None] + ends[..., 0]
    angle = wall_angle(np, ends[..., 1], ends[..., 2] + float(params.lidar.mount.height))
    near = (shown > 0.0) & (np.abs(ends[..., 0]) < 6.0) & (along > _BEGIN) & (along < _END)
    value = np.log(shown[near]) + np.log(scan[near])
    cell = [np.clip(((x - low) / (high - low) * n).astype(int), 0, n - 1) for x, low, high, n in (
        (along[near], _BEGIN, _END, _CELLS[0]), (angle[near], -np.pi, np.pi, _CELLS[1]))]  # fmt: skip
    flat = cell[1] * _CELLS[0] + cell[0]
    total, count = (np.bincount(flat, w, _CELLS[0] * _CELLS[1]).reshape(_CELLS[::-1]) for w in (value, None))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total.sum(axis=1) / count.sum(axis=1)
        return np.asarray(total / count - mean[:, None])
