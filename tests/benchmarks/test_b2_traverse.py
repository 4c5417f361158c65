"""Robots that several processes drive are as many as asked, in their order, with rows as long as the longest."""

import dataclasses
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from benchmarks import b2_traverse
from benchmarks.b2_traverse import Command
from subterra_jax.b2.transfer import Row, Walk
from tests.recorded import check, lines_of

VALUES = Path(__file__).with_name("values.csv")


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


def test_robots_have_seeds_tunnels_and_levels_by_their_number_whoever_drives_them(monkeypatch):
    env, params = SimpleNamespace(levels=lambda _: [0, 2, 4]), SimpleNamespace(tunnel=SimpleNamespace(count=2))
    cores = []
    for place, name, value in (
        (b2_traverse, "_open", lambda _: (env, params)), (b2_traverse, "open_agent", lambda *_: "agent"),
        (b2_traverse.transfer, "walk_robots", lambda env, params, agent, episodes, watch: (episodes, watch)),
        (b2_traverse.os, "sched_getaffinity", lambda _: {3, 5, 7}),
        (b2_traverse.os, "sched_setaffinity", lambda _, some: cores.append(some)),
    ):  # fmt: skip
        monkeypatch.setattr(place, name, value)
    whole, watch, _ = b2_traverse._drive(Command(robots=13, seed=5))
    assert (watch, cores) == (b2_traverse.show_progress, [])
    parts = [b2_traverse._drive(Command(robots=13, seed=5, jobs=3), job) for job in range(3)]
    assert [watch for _, watch, _ in parts] == [None] * 3
    assert cores == [[3], [5], [7]]
    for name, expected in {
        "seed": np.arange(5, 18), "tunnel": [0, 1] * 6 + [0], "group": 13 * [0],
        "severity": [0, 0, 2, 2, 4, 4] * 2 + [0],
    }.items():  # fmt: skip
        np.testing.assert_array_equal(getattr(whole, name), expected, name)
        np.testing.assert_array_equal(np.concatenate([getattr(some, name) for some, *_ in parts]), expected, name)


def test_what_is_asked_for_is_made_and_named_in_the_records(monkeypatch):
    monkeypatch.setattr(b2_traverse.st, "make", lambda id, **options: (id, options))
    figures = {
        "robots": 40.0,
        "success_percent": 12.5,
        "fall_percent": 0.0,
        "pitch_sigma_deg": 0.444,
        "range_off_p95": 0.123456,
    }
    asked = (
        Command(), Command("rover", robots=40, speed=0.8, tunnel="control", coverage=0.3, length=20.0),
        Command("wheels", "StopAt-v1", tunnel="open:cast:val:0-1", engine="mujoco", jobs=3, seed=4),
        Command("rover", "Subterra/Return-v1", scene=Path("build/metro"), agent="out/Some.safetensors", out=Path("x")),
    )  # fmt: skip
    told = {f"made {k}": str(b2_traverse._open(one)) for k, one in enumerate(asked) if not one.length}
    told |= {f"records {k}": lines_of(b2_traverse.records_of(one, figures)) for k, one in enumerate(asked)}
    (id, options) = b2_traverse._open(asked[1])
    assert (id, options.pop("tunnel").length) == ("Subterra/Traverse-v1", 20.0)
    check(VALUES, "robots by physics", told | {"options": str(options)})
