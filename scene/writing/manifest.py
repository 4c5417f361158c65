"""`manifest.json`: what went in, how it was treated, what came out, and what of it was measured."""

import dataclasses
import hashlib
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

SCHEMA = "subterra.manifest/1"
_LIBRARIES = (
    "numpy",
    "scipy",
    "trimesh",
    "manifold3d",
    "mujoco",
    "rosbags",
    "small-gicp",
    "plyfile",
    "pypcd4",
    "laspy",
    "lazrs",
    "pye57",
    "pyarrow",
    "openpyxl",
    "shapely",
)


def write(path: Path, content: dict[str, Any], config: Any) -> None:
    """Writes the manifest with schema, config, library versions and the folder's hashes added; keys sorted."""
    whole = {
        "schema": SCHEMA,
        "files": hashes(path.parent),
        "config": _plain(dataclasses.asdict(config)),
        "versions": {name: version(name) for name in _LIBRARIES},
        **_plain(content),
    }
    path.write_text(json.dumps(whole, indent=2, sort_keys=True) + "\n")


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a folder by its name, so that who reads a scene can tell whether it is whole."""
    found = {}
    for file in sorted(file for file in folder.rglob("*") if file.is_file()):
        with file.open("rb") as opened:
            found[file.relative_to(folder).as_posix()] = hashlib.file_digest(opened, "sha256").hexdigest()
    return found


def _plain(value: Any) -> Any:
    """The value in JSON's types; floats to 9 digits."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.9g}")
    if isinstance(value, np.integer):
        return int(value)
    return str(value) if isinstance(value, Path) else value
