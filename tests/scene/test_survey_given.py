"""A tunnel file as truth: every kind of lining is surveyed through one door."""

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import subterra_jax as st
from scene.survey.__main__ import main
from scene.survey.given import read_given
from scene.survey.mesh import Part
from scene.survey.rolled import Sheet, place_recesses, wall_mesh
from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d.rolled import raise_shell
from subterra_jax.procedural.open_world import draw, plan
from tests.scene import surveyed
from tests.scene.surveyed import frames, load_cast, load_trajectory
from tests.subterra_jax import tunnels

KINDS = {
    "straight": "val", "universal": "test-unseen", "cast": "val", "sprayed": "val", "masonry": "val",
    "rock": "test-unseen",
}  # fmt: skip
LENGTH = 40.0
WORDS = ("--length", 20, "--seed", 5, "--point-rate", 24_000, "--truth-file")


def name_of(kind: str) -> str:
    return f"open:{kind}:{KINDS[kind]}:900010"


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple:
    made = plan(name_of(request.param), length=LENGTH)
    path = tmp_path_factory.mktemp(request.param) / "tunnel.npz"
    st.tunnel.save_tunnel(made, path)
    return request.param, path, made


@pytest.fixture(scope="module")
def universal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("universal") / "tunnel.npz"
    st.tunnel.save_tunnel(plan(name_of("universal"), length=LENGTH), path)
    return path


@pytest.fixture(scope="module")
def survey(universal: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return surveyed.survey(tmp_path_factory.mktemp("survey"), *WORDS, universal)


def cast(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray, ray: np.ndarray) -> np.ndarray:
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    return scene.run(start.astype(np.float32), ray.astype(np.float32), query="DISTANCE")


def test_the_surface_is_that_of_the_shell_by_another_triangulation(kind) -> None:
    name, path, made = kind
    bore = read_given(path, "", LENGTH)
    mesh = bore.mesh()
    _, shell = raise_shell(made.shell, "built")
    rng = np.random.default_rng(0)
    count = 20_000
    at = bore.alignment.frames(rng.uniform(5.0, LENGTH - 5.0, count))
    start = at.point(rng.uniform(-0.4, 0.4, count), rng.uniform(-0.5, 0.5, count))
    ray = rng.normal(size=(count, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.abs(np.einsum("ij,ij->i", ray, at.tangent)) < 0.7
    start, ray = start[across], ray[across]
    mine, theirs = (cast(m.vertices, m.faces, start, ray) for m in (mesh, shell))
    assert np.mean(np.maximum(mine, theirs) > 50.0) < 1e-3
    off = np.abs(mine - theirs)
    assert np.median(off) < 2e-3, name
    assert np.mean(off > 0.05) < 2e-3, name
    assert {"rock", "sprayed"} & {name} or (mesh.part == Part.POCKET).any()


def test_no_ray_from_inside_meets_a_surface_from_behind(kind) -> None:
    _, path, _ = kind
    bore = read_given(path, "", LENGTH)
    mesh = bore.mesh()
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    rng = np.random.default_rng(1)
    start = bore.alignment.frames(rng.uniform(1.0, LENGTH - 1.0, 20_000)).position.astype(np.float32)
    ray = rng.normal(size=start.shape).astype(np.float32)
    hit = scene.run(start, ray, output=True)
    met = hit["primID"] >= 0
    assert met.mean() > 0.9
    assert not (np.einsum("ij,ij->i", hit["Ng"], ray)[met] > 0.0).any()


def test_returns_lie_on_the_truth_and_pockets_are_where_they_were_drawn(survey: Path) -> None:
    truth = json.loads((survey / "truth.json").read_text())
    assert truth["schema"] == "subterra.truth/1"
    assert truth["length"] == pytest.approx(20.0, abs=0.02)
    assert truth["config"]["truth_file"]["tunnel"] == name_of("universal")
    position, _, _, up = frames(truth)
    np.testing.assert_allclose(np.linalg.norm(np.diff(position, axis=0), axis=1), 0.25, atol=1e-4)
    reach = load_cast(survey / "truth.ply")
    height = reach(position[8:-8], up[8:-8]) + reach(position[8:-8], -up[8:-8])
    bare = np.abs(height - np.array(truth["height"])[8:-8]) < 2e-3  # others meet a pocket
    assert bare.mean() > 0.7
    drawn = draw(name_of("universal"), LENGTH).bore.pocket
    inside = drawn[drawn[:, 0] + 0.5 * drawn[:, 2] < 20.0]
    assert len(truth["pockets"]) == len(inside)
    centre, outward = (np.array([pocket[name] for pocket in truth["pockets"]]) for name in ("position", "outward"))
    depth = np.array([pocket["depth"] for pocket in truth["pockets"]])
    np.testing.assert_allclose(reach(centre - 0.5 * outward, outward), 0.5 + depth, atol=4e-3)
    assert load_trajectory(survey / "groundtruth.tum").time[-1] > 1_700_000_020


def test_the_same_seed_gives_the_same_bytes(universal: Path, survey: Path, tmp_path: Path) -> None:
    surveyed.survey(tmp_path, *WORDS, universal)
    for path in survey.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


def test_a_packaged_tunnel_is_surveyed_with_its_track() -> None:
    with resources.as_file(resources.files("subterra_jax") / "data" / "metro.npz") as path:
        bore = read_given(path, "", 30.0)
    parts = np.bincount(bore.mesh().part, minlength=9)
    assert parts[Part.SLEEPER] / 12 == pytest.approx(30.0 / 0.6, abs=1.0)
    assert parts[Part.RAIL] > 0
    assert parts[Part.POCKET] > 0
    assert parts[Part.THING] == 0


def areas(recesses: np.ndarray) -> np.ndarray:
    """Areas of the triangles of a tube with recesses, m²."""
    station, angle = np.arange(0.0, 4.01, 0.5), np.linspace(-0.5 * np.pi, 1.5 * np.pi, 73)
    ring = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=-1)
    vertex = 2.0 * ring[None] + station[:, None, None] * [1.0, 0.0, 0.0]
    sheet = Sheet(station, angle, 2.0 * (angle - angle[0]), vertex, station[:, None] * [1.0, 0.0, 0.0])
    mesh = wall_mesh(sheet, place_recesses(sheet, recesses))
    corner = mesh.vertices[mesh.faces]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def test_recesses_that_share_cells_are_cut_whole_each() -> None:
    """Side by side within one cell: the wall loses nothing but the mouths, which the backs give back."""
    pockets = np.array([[2.0, 0.2, 0.3, 0.2, 0.1], [2.2, 0.35, 0.05, 0.05, 0.1], [2.0, 1.5, 0.7, 0.4, 0.2]])
    sides = sum(2.0 * (length + width) * depth for _, _, length, width, depth in pockets)
    assert areas(pockets).sum() - areas(pockets[:0]).sum() == pytest.approx(sides, rel=0.01)


def test_what_is_no_truth_is_refused_in_one_sentence(
    universal: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planar = tunnels.write_tunnel(tmp_path / "planar.npz", tunnels.tunnel_arrays(tunnels.straight(20.0)))
    (tmp_path / "text.npz").write_text("no archive")
    cases = [
        (["--truth-file", planar], "holds no bore in three dimensions"),
        (["--truth-file", tmp_path / "none.npz"], "no such tunnel file"),
        (["--truth-file", tmp_path / "text.npz"], "not a readable .npz archive"),
        (["--truth-file", universal, "--lining", "wood"], "there is no lining 'wood'; there are built, bare, smooth"),
        (["--truth-file", universal, "--length", 60], f"length must be at most {LENGTH:g} m"),
        (["--truth-file", universal, "--truth", "metro"], "give neither truth nor tolerances"),
        (["--lining", "built"], "lining goes with truth-file alone"),
    ]
    for words, sentence in cases:
        words = [*words, "--out", tmp_path / "out"]
        assert main([str(word) for word in ([] if "--length" in words else ["--length", 20]) + words]) == 2
        told = capsys.readouterr().err.strip()
        assert sentence in " ".join(told.split()), told
        assert not (tmp_path / "out").exists()


def test_a_plan_without_a_shell_is_saved_for_planar_sensors_and_a_piece_of_one_is_not(tmp_path: Path) -> None:
    st.tunnel.save_tunnel(plan(name_of("cast"), solid=False, length=LENGTH), tmp_path / "t.npz")
    assert st.load_tunnel(tmp_path / "t.npz").shell is None
    with pytest.raises(ValueError, match=r"holds no bore in three dimensions \(it is planar"):
        read_given(tmp_path / "t.npz", "", LENGTH)
    with pytest.raises(TunnelError, match="piece of a tunnel"):
        st.tunnel.save_tunnel(plan(name_of("cast"), length=LENGTH).slice(5.0, 10.0), tmp_path / "t.npz")


def test_a_saved_tunnel_loads_as_it_was(tmp_path: Path) -> None:
    made = plan(name_of("universal"), length=LENGTH)
    st.tunnel.save_tunnel(made, tmp_path / "t.npz")
    loaded = st.load_tunnel(tmp_path / "t.npz")
    assert (loaded.name, loaded.ring_pitch, loaded.lidar_height) == (made.name, made.ring_pitch, made.lidar_height)
    np.testing.assert_allclose(loaded.ring_joint, made.ring_joint, atol=6e-6)
    np.testing.assert_allclose(loaded.shell.radius, made.shell.radius, atol=6e-5)
    np.testing.assert_allclose(loaded.shell.linings["smooth"].radius, made.shell.linings["smooth"].radius, atol=6e-5)
    np.testing.assert_allclose(loaded.shell.tangent, made.shell.tangent, atol=2e-5)
    np.testing.assert_allclose(loaded.lining("built").left.vertex, made.lining("built").left.vertex, atol=6e-6)
    np.testing.assert_allclose(loaded.shell.spacing, made.shell.spacing, atol=6e-6)
