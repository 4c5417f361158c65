"""The `info` of a batch as Gymnasium's vector environments give it: arrays, and in `_name` who has an entry."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from subterra_jax.adapters.report import Report
from subterra_jax.adapters.spaces import as_observation


def masked(info: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Entries of those environments that have any; 0 in the others, and nothing at all where nobody has.

    Args:
        info: Arrays `(n, ...)`; a number of 32 bits becomes Python's own kind, as it does when environments are
            gathered one by one.
        mask: Who has entries, `(n,)`.
    """
    told: dict[str, Any] = {}
    if mask.any():
        for name, values in info.items():
            wide = values.astype({"f": np.float64, "i": np.int64}.get(values.dtype.kind, values.dtype))
            wide[~mask] = 0
            told[name], told[f"_{name}"] = wide, mask.copy()
    return told


def ended_infos(told: Report, done: np.ndarray, fields: Mapping[str, slice] | None) -> dict[str, Any]:
    """`final_obs` and `final_info` of the episodes that ended in this step; empty where none did.

    Args:
        told: What the batch told.
        done: Which environments ended, `(n,)`.
        fields: Names of the parts of an observation, if it is a dict.
    """
    if not done.any():
        return {}
    final = np.full(len(done), None, dtype=object)
    for index in np.flatnonzero(done):
        final[index] = as_observation(np.array(told.obs[index]), fields)
    return {
        "final_obs": final,
        "_final_obs": done.copy(),
        "final_info": masked(told.info, done),
        "_final_info": done.copy(),
    }
