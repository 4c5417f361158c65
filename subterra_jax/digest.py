"""The digest of the numbers that define the benchmark.

Every number enters under a key, its dotted path at the time when the key was made. Class names do not enter. Whoever
renames a part or a field gives the old key in `RENAMED`: the tests list every key and its value.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

import jax
import numpy as np

from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

RENAMED: dict[str, str] = {}  # beginning of a path today: what its keys begin with


def task_figures(env: TunnelEnv, params: EnvParams) -> dict[str, Any]:
    """Return the numbers of a task by key, whatever its tunnel, and the keys of rule and parts."""
    leaves = jax.tree_util.tree_flatten_with_path({"horizon": params.horizon, **params.parts})[0]
    return {
        "rule": env.rule.key,
        "parts": [key_of(part.name) for part in (env.motion, *env.parts)],
        "beams": params.lidar.n_beams,
        "numbers": {
            key_of(jax.tree_util.keystr(path, simple=True, separator=".")): plain(leaf) for path, leaf in leaves
        },
    }


def key_of(path: str) -> str:
    """Return the key of a dotted path."""
    for begin, key in RENAMED.items():
        if path == begin or path.startswith(f"{begin}."):
            return key + path.removeprefix(begin)
    return path


def plain(leaf: Any) -> Any:
    """Return a number or an array as plain values that JSON writes in one way."""
    return np.round(np.asarray(leaf, np.float64), 9).tolist()


def digest(content: Any) -> str:
    """Return the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
