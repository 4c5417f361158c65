"""What is shipped: the paper's counts hold in `subterra-351`, and no file is larger than it need be."""

import json
import re
import zlib
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.tunnel.shell import Shell, brick_corners
from subterra_jax.tunnel.sources import PACKAGED

DATA = resources.files("subterra_jax") / "data"
MARGIN = 0.10  # m between the end of a sleeper and the wall


def manifest(name: str) -> dict:
    return json.loads((DATA / f"{name}.json").read_text())


def clearances(shell: Shell, sleeper: np.ndarray) -> np.ndarray:
    """Distance of each sleeper's left and right end from the wall at the level of its top, m, `(k, 2)`."""
    found = []
    for corners in brick_corners(sleeper):
        row = int(np.argmin(np.sum((shell.position - corners.mean(axis=0)) ** 2, axis=1)))
        apart = corners - shell.position[row]
        across, level = apart @ shell.left[row], float((apart @ shell.up[row]).max())
        wall = shell.radius[row] * np.cos(shell.angle), shell.radius[row] * np.sin(shell.angle)
        ends = []
        for side in (1.0, -1.0):
            half = np.flatnonzero(side * wall[0] > 0.0)
            order = half[np.argsort(wall[1][half])]
            # The wall a little above the corner that it makes with the floor.
            ends.append(np.interp(level + 0.05, wall[1][order], side * wall[0][order]) - (side * across).max())
        found.append(ends)
    return np.array(found)


@pytest.fixture(scope="module")
def shell() -> Shell:
    return st.load_tunnel("subterra-351").shell


@pytest.fixture(scope="module")
def sleeper(shell: Shell) -> np.ndarray:
    return shell.track[shell.track[:, 12] > 0.0]  # alone they taper


def test_subterra_351_has_the_586_sleepers_of_the_paper_all_of_them_whole_between_its_mouths(shell, sleeper):
    assert len(sleeper) == manifest("subterra-351")["count"]["sleepers"] == 586
    station = np.sort(np.argmin(np.linalg.norm(shell.position[None] - sleeper[:, None, :3], axis=2), axis=1))
    along = shell.station[station]
    assert np.median(np.diff(along)) == pytest.approx(0.6, abs=0.15)  # to a station
    assert np.mean(np.diff(np.sort(along))) == pytest.approx(0.599, abs=0.002)
    assert along.min() > 0.1
    assert along.max() < shell.station[-1] - 0.1


def test_each_sleeper_keeps_its_distance_from_both_walls_and_one_that_does_not_is_noticed(shell, sleeper):
    free = clearances(shell, sleeper)
    assert free.min() > MARGIN
    assert free.max() < 2.0
    aside = sleeper.copy()
    aside[:, :3] += 1.6 * sleeper[:, 6:9] / np.linalg.norm(sleeper[:, 6:9], axis=1, keepdims=True)
    moved = clearances(shell, aside)
    np.testing.assert_allclose(np.abs(moved - free).mean(axis=0), 1.6, atol=0.05)
    assert moved.min(axis=1).max() < MARGIN


def test_a_nail_joins_most_pockets_to_the_next_of_their_joint():
    facts = manifest("subterra-351")
    alone = facts["count"]["pockets"] - 2 * facts["count"]["nails"]
    # The truth has 5 % of its pockets mortared flush, and 3 % of the pairs without a nail.
    assert 0 <= alone < 0.09 * facts["count"]["pockets"]
    pocket = st.load_tunnel("subterra-351").shell.linings["pockets"].pocket
    assert len(pocket) == pytest.approx(facts["count"]["pockets"], abs=3)  # but any at the very mouths
    assert np.median(pocket[:, 4]) == pytest.approx(0.13, abs=0.005)


@pytest.mark.parametrize("name", PACKAGED)
def test_a_packaged_tunnel_is_one_small_file_with_plane_and_heights_and_says_what_built_it_and_when(name):
    plan, facts = st.load_tunnel(name), manifest(name)
    assert (plan.name, plan.provenance) == (facts["name"], facts["input_provenance"])
    assert plan.length == pytest.approx(facts["bore"]["length"], abs=1e-5)
    assert set(plan.shell.linings) == set(plan.linings) == {"smooth", "pockets", "furnished"}
    assert re.fullmatch(r"\d+\.\d+\.\d+", facts["builder"])  # an older one: no release builds them anew
    assert facts["config"]["date"] >= "2026-11-26"
    assert (DATA / f"{name}.npz").stat().st_size < 800_000


def test_the_walls_in_the_plane_are_those_of_the_shell(shell):
    """One file has both: half a width apart they would be two tunnels."""
    plan = st.load_tunnel("subterra-351")
    level = plan.elevation + plan.lidar_height - shell.position[:, 2]
    for side, wall in ((1.0, plan.lining("smooth").left), (-1.0, plan.lining("smooth").right)):
        across = []
        for row in range(0, len(shell.station), 20):
            y, z = side * shell.radius[row] * np.cos(shell.angle), shell.radius[row] * np.sin(shell.angle)
            half = np.flatnonzero(y > 0.0)
            order = half[np.argsort(z[half])]
            across.append(np.interp(level[row], z[order], y[order]))
        at = shell.station[::20]
        there = np.column_stack([np.interp(at, wall.station, wall.vertex[:, k]) for k in (0, 1)])
        middle = np.column_stack([np.interp(at, plan.station, plan.centre[:, k]) for k in (0, 1)])
        np.testing.assert_allclose(np.linalg.norm(there - middle, axis=1)[1:-1], np.array(across)[1:-1], atol=0.03)


def test_what_is_shipped_packs_into_a_wheel_of_10_mb():
    root = resources.files("subterra_jax")
    with resources.as_file(root) as folder:
        files = [file for file in Path(folder).rglob("*") if file.is_file() and "__pycache__" not in file.parts]
        packed = {file.name: len(zlib.compress(file.read_bytes(), 6)) for file in files}
    assert sum(packed.values()) < 9_900_000, f"the largest is {max(packed, key=packed.__getitem__)}"
