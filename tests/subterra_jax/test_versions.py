"""Files and ids of another version say what to do."""

import json
import shutil
import tomllib
from importlib import resources
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import subterra_jax as st
from scene.bore import load_bore
from scene.errors import RecordingError as SceneError
from subterra_jax import policies
from subterra_jax.host.task_ids import no_task
from subterra_jax.host.versions import VERSION, other_schema
from subterra_jax.policies.files import PolicyError
from train import checkpoint
from train.checkpoint import CheckpointError
from train.world import library_versions

ROOT = Path(__file__).parents[2]


def packaged(name: str) -> Path:
    return Path(str(resources.files("subterra_jax"))) / "data" / name


def other(path: Path, out: Path, schema: str) -> Path:
    """A copy of an archive under another schema."""
    with np.load(path) as data:
        np.savez(out, **{**data, "schema": np.array(schema)})
    return out


def test_the_version_is_that_of_the_package():
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == VERSION == st.__version__
    assert f"version: {VERSION}" in (ROOT / "CITATION.cff").read_text()


def test_what_is_released_from_a_bare_checkout_knows_its_version(monkeypatch):
    monkeypatch.setattr("train.world.metadata.distributions", lambda: [])
    assert library_versions()["subterra-jax"] == VERSION
    assert library_versions()["jax"] == "not installed"


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ("subterra.tunnel/0", f"written by an older Subterra (schema subterra.tunnel/0; version {VERSION} reads "),
        ("subterra.tunnel/2", f"written by a newer Subterra (schema subterra.tunnel/2; version {VERSION} reads "),
        ("subterra.bore/1", "field 'schema' must be 'subterra.tunnel/1', is 'subterra.bore/1'"),
        ("subterra.tunnel/x", "field 'schema' must be 'subterra.tunnel/1', is 'subterra.tunnel/x'"),
        (None, "field 'schema' must be 'subterra.tunnel/1', is missing"),
    ],
)
def test_a_schema_is_older_newer_or_of_another_file(found, says):
    assert other_schema(found, "subterra.tunnel/1", "build again").startswith(says)


def test_a_tunnel_of_another_version_says_what_to_do(tmp_path):
    old = other(packaged("subterra-351.npz"), tmp_path / "old.npz", "subterra.tunnel/0")
    with pytest.raises(st.TunnelError, match=r"old\.npz: written by an older .* `python -m scene\.build`"):
        st.load_tunnel(old)
    new = other(packaged("subterra-351.npz"), tmp_path / "new.npz", "subterra.tunnel/7")
    with pytest.raises(st.TunnelError, match=r"new\.npz: written by a newer .* pip install --upgrade"):
        st.load_tunnel(new)


def test_a_bore_of_another_version_says_what_to_do(tmp_path):
    np.savez(tmp_path / "bore.npz", schema=np.array("subterra.bore/0"))
    with pytest.raises(SceneError, match=r"another version of Subterra wrote it; .* `python -m scene\.build`"):
        load_bore(tmp_path / "bore.npz")


def test_an_archive_that_was_cut_short_is_no_bore_and_no_tunnel(tmp_path):
    cut = tmp_path / "cut.npz"
    cut.write_bytes(packaged("subterra-351.npz").read_bytes()[:50_000])
    with pytest.raises(st.TunnelError, match="cut short"):
        st.load_tunnel(cut)
    with pytest.raises(SceneError, match="not a bore file"):
        load_bore(cut)


@pytest.mark.parametrize(("number", "says"), [(0, "older .* `python -m train.release`"), (2, "newer .* --upgrade")])
def test_a_policy_of_another_version_says_what_to_do(tmp_path, number, says):
    for ending in (".safetensors", ".json"):
        shutil.copy(packaged("policies") / f"TraverseShort-v1{ending}", tmp_path / f"mine{ending}")
    facts = json.loads((tmp_path / "mine.json").read_text())
    (tmp_path / "mine.json").write_text(json.dumps({**facts, "schema": f"subterra.policy/{number}"}))
    with pytest.raises(PolicyError, match=says):
        policies.load(tmp_path / "mine.safetensors")


def test_a_checkpoint_of_another_version_says_what_to_do(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 3, {"policy": {"w": np.zeros(2, np.float32)}}, {"task": "t"})
    (facts,) = tmp_path.rglob(checkpoint.FACTS)
    name, _, number = checkpoint.SCHEMA.rpartition("/")
    for told, says in ((int(number) - 1, "older .*--overwrite"), (int(number) + 1, "newer .* --upgrade")):
        facts.write_text(json.dumps({**json.loads(facts.read_text()), "schema": f"{name}/{told}"}))
        with pytest.raises(CheckpointError, match=says):
            checkpoint.load_checkpoint(tmp_path)


def test_gymnasium_names_the_id_of_a_version_that_is_gone():
    for id in ("Subterra/StopAt-v0", "Subterra/B2Traverse-v0"):
        with pytest.raises(gymnasium.error.DeprecatedEnv, match=id.replace("-v0", "-v1")):
            gymnasium.make(f"subterra_jax:{id}")
    with pytest.raises(gymnasium.error.NameNotFound, match="Did you mean"):
        gymnasium.make("subterra_jax:Subterra/StopAtOffset-v0")


def test_an_id_that_never_was_lists_those_there_are():
    known = ("Subterra/StopAt-v1", "Subterra/Return-v1")
    for id in ("StopAt-v1", "StopAt", "StopAt-v7"):
        assert no_task(id, known) == f"no task {id!r}: its id is Subterra/StopAt-v1"
    assert no_task("Fly", known) == "no task 'Fly'; there are Subterra/StopAt-v1, Subterra/Return-v1"
    with pytest.raises(gymnasium.error.VersionNotFound, match="StopAt"):
        gymnasium.make("subterra_jax:Subterra/StopAt-v7")
