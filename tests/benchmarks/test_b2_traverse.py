"""Robots that several processes drive are as many as asked, in their order, with rows as long as the longest."""

import dataclasses
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np

from benchmarks import b2_traverse
from benchmarks.b2_traverse import Command
from subterra_jax.b2.transfer import Row, Walk


def test_shares_of_several_processes_are_put_together(monkeypatch):
    def drive(arguments: Command, share: int) -> tuple[Walk, Row, str]:
        steps, robots = 3 + share, np.full(2, float(share))
        row = np.full((steps, 2), float(share))
        names = {field.name: robots for field in dataclasses.fields(Walk)}
        return (
            Walk(**names),
            Row(row, row[..., None], row[..., None], row[..., None], row[..., None]),
            f"params {share}",
        )

    pool = nullcontext(SimpleNamespace(map=lambda work, *shares: list(map(work, *shares))))
    monkeypatch.setattr(b2_traverse, "ProcessPoolExecutor", lambda *_: pool)
    monkeypatch.setattr(b2_traverse, "_drive", drive)
    walk, rows, params = b2_traverse._drive_all(Command(robots=6, jobs=3))
    assert walk.fall.tolist() == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]
    assert (rows.lateral.shape, rows.sway.shape, params) == ((5, 6), (5, 6, 1), "params 0")
    assert np.isnan(rows.lateral).sum(axis=0).tolist() == [2, 2, 1, 1, 0, 0]
