"""A straight tunnel, written as docs/formats.md says."""

from pathlib import Path

import numpy as np


def write(path: Path, length: float, half_width: float) -> Path:
    station = np.arange(0.0, length + 0.25, 0.5)
    ones, zeros = np.ones_like(station), np.zeros_like(station)
    fields = {
        "schema": np.array("subterra.tunnel/3"),
        "name": np.array("corridor"),
        "provenance": np.array("simulated"),
        "station": station,
        "centre": np.stack([station, zeros], axis=1),
        "tangent": np.stack([ones, zeros], axis=1),
        "elevation": zeros,
        "half_width": half_width * ones,
        "lidar_height": np.array(0.6),
        "lining": np.array(["smooth", "pockets"]),
    }
    for lining in ("smooth", "pockets"):
        for side, sign in (("left", 1.0), ("right", -1.0)):
            fields[f"{side}_{lining}"] = np.stack([station, sign * half_width * ones], axis=1)
            fields[f"{side}_station_{lining}"] = station
        fields[f"furniture_{lining}"] = np.zeros((0, 4))
    np.savez(path, **fields)
    return path
