"""The scores of all entries: each on its task, and each agent over all tasks."""

from typing import Any

import numpy as np

from benchmarks.leaderboard.entries import Entry
from subterra_jax.baselines.registry import CEILING, DEAD_RECKONING
from subterra_jax.evaluation.summary import grouped, interquartile_mean, interval, normalised, summary

_SEED = 0


def scores(entries: list[Entry]) -> list[dict[str, Any]]:
    """One row for each entry: who, where, what it uses, its summary and its normalised score."""
    rows = []
    for entry in entries:
        row: dict[str, Any] = {"task": entry.task, "world": entry.world, "agent": entry.agent, **entry.traits}
        row |= summary(entry.records, _SEED)
        floor, ceiling = _success(entries, entry, DEAD_RECKONING), _success(entries, entry, CEILING)
        row["bounds"], row["normalised"] = entry.bounds, None
        if floor is not None and ceiling is not None:
            row["normalised"] = normalised(row["success"], floor, ceiling)
        rows.append(row)
    return rows


def totals(entries: list[Entry]) -> list[dict[str, Any]]:
    """One row for each agent in each world: inter-quartile mean of its normalised scores over all tasks.

    Tasks on which dead reckoning does as well as the oracle tell nothing and are left out. Every group of episodes of
    every task is one score; the interval draws groups within tasks.
    """
    rows = []
    for world, agent in dict.fromkeys((e.world, e.agent) for e in entries):
        groups = [g for e in entries if (e.world, e.agent) == (world, agent) and (g := _groups(entries, e)) is not None]
        if not groups:
            continue
        size = min(len(g) for g in groups)
        table = np.stack([g[:size] for g in groups])
        low, high = interval(table, _means, _SEED)
        rows.append(
            {
                "world": world,
                "agent": agent,
                "tasks": len(table),
                "normalised_iqm": interquartile_mean(table.ravel()),
                "low": low,
                "high": high,
            }
        )
    return sorted(rows, key=lambda row: (row["world"], -row["normalised_iqm"]))


def _groups(entries: list[Entry], entry: Entry) -> np.ndarray | None:
    """Normalised score of each group of episodes of an entry; None where its task tells nothing."""
    floor, ceiling = _success(entries, entry, DEAD_RECKONING), _success(entries, entry, CEILING)
    if floor is None or ceiling is None or normalised(ceiling, floor, ceiling) is None:
        return None
    means = grouped(entry.records.success.astype(float), entry.records.group).mean(axis=1)
    return (means - floor) / (ceiling - floor)


def _means(tables: np.ndarray) -> np.ndarray:
    """Inter-quartile mean of each table in a stack."""
    return np.array([interquartile_mean(table.ravel()) for table in tables])


def _success(entries: list[Entry], like: Entry, agent: str) -> float | None:
    """Success of another agent in the same task and world."""
    for entry in entries:
        if (entry.task, entry.world, entry.agent) == (like.task, like.world, agent):
            return float(entry.records.success.mean())
    return None
