"""Host plumbing: command lines, exit statuses, files that appear whole or not at all, and the lazy package."""

import dataclasses
import json
import os
import pickle
import pkgutil
import shutil
import subprocess
import sys
import tomllib
import warnings
from importlib import resources
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import tyro

import subterra_jax
import subterra_jax as st
from subterra_jax import list_tasks, policies
from subterra_jax.__main__ import COMMANDS, main
from subterra_jax.host.command import INPUT_ERRORS, parse, run_command
from subterra_jax.host.errors import OutputError, SubterraError
from subterra_jax.host.files import replace_file
from subterra_jax.host.task_ids import no_task
from subterra_jax.host.versions import VERSION, other_schema
from subterra_jax.policies.files import PolicyError
from subterra_jax.tunnel.sources import named
from train import checkpoint
from train.checkpoint import CheckpointError
from train.world import library_versions


@dataclasses.dataclass(frozen=True)
class Rare:
    """Options that hardly anybody sets."""

    depth: float = 1.0
    """Depth, m."""


@dataclasses.dataclass(frozen=True)
class Common:
    """Does a thing.

    Example: python -m thing --out here
    """

    out: str
    """Folder."""
    kind: int = 1
    """Which."""
    rare: Rare = dataclasses.field(default_factory=Rare)


def read(*words: str) -> Common:
    return parse(lambda given: tyro.cli(Common, args=given, prog="thing"), list(words))


def shown(capsys, *words: str) -> str:
    with pytest.raises(SystemExit) as ended:
        read(*words)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_a_command_line_without_a_mistake_is_read_as_tyro_reads_it(capsys):
    assert read("--out", "here", "--rare.depth", "2") == Common("here", rare=Rare(2.0))
    assert capsys.readouterr() == ("", "")


def test_help_shows_the_commands_own_options_and_names_the_other_groups(capsys):
    page = shown(capsys, "--help")
    assert "--kind INT" in page
    assert "Example: python -m thing" in page
    assert "Depth, m" not in page
    assert page.endswith("--help-all shows further options: rare.\n")


def test_all_help_shows_every_group(capsys):
    page = shown(capsys, "--help-all")
    assert "--kind INT" in page
    assert "--rare.depth FLOAT" in page


def fail(error: BaseException):
    def act() -> None:
        raise error

    return act


def test_a_command_ends_with_its_own_status_or_0():
    assert run_command(lambda: None) == 0
    assert run_command(lambda: 7) == 7
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        run_command(lambda: warnings.warn("Mean of empty slice", RuntimeWarning, stacklevel=1))
    assert not shown, "a warning of a library reached the user"


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (SubterraError("a mistake\nof two lines"), 2, "error: a mistake of two lines\n"),
        (FileNotFoundError(2, "No such file", "there.bag"), 2, "error: there.bag: No such file\n"),
        (KeyboardInterrupt(), 130, "stopped\n"),
    ],
)
def test_a_mistake_or_an_interrupt_is_one_sentence_and_a_status(capsys, error, status, sentence):
    assert run_command(fail(error), "stopped", mistakes=INPUT_ERRORS) == status
    assert capsys.readouterr().err == sentence


def test_a_reader_that_leaves_early_is_no_error():
    """As `| head` does, once it has what it wants."""
    command = [sys.executable, "-m", "subterra_jax", "tasks"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 141


def test_an_error_of_the_program_keeps_its_traceback():
    with pytest.raises(ValueError, match="a fault"):
        run_command(fail(ValueError("a fault")))


def interrupt_while_writing(path):
    path.write_text("half")
    raise KeyboardInterrupt


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "file.txt"
    with replace_file(path) as fresh:
        fresh.write_text("first")
        assert not path.exists()
    with pytest.raises(KeyboardInterrupt), replace_file(path) as fresh:
        interrupt_while_writing(fresh)
    assert path.read_text() == "first"
    assert list(path.parent.iterdir()) == [path]


def test_two_processes_may_write_the_same_file(tmp_path):
    path = tmp_path / "file.txt"
    other = "import sys; from pathlib import Path; from subterra_jax.host.files import replace_file\n"
    other += "with replace_file(Path(sys.argv[1])) as fresh: fresh.write_text('other')"
    with replace_file(path) as fresh:
        fresh.write_text("own")
        subprocess.run([sys.executable, "-c", other, str(path)], check=True)
        assert path.read_text() == "other"
    assert path.read_text() == "own"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_left_of_a_file_goes_after_a_day(tmp_path):
    path = tmp_path / "file.txt"
    old, young = tmp_path / ".file.txt.1.partial", tmp_path / ".file.txt.2.partial"
    for left in (old, young):
        left.write_text("half")
    os.utime(old, (0, 0))
    with replace_file(path) as fresh:
        fresh.write_text("whole")
    assert not old.exists()
    assert young.exists()


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"), replace_file(tmp_path) as fresh:
        fresh.write_text("in the place of a folder")
    assert list(tmp_path.parent.glob(".*.partial")) == []


def test_every_public_name_of_the_package_is_found_listed_and_no_module():
    assert set(st.__all__) <= set(dir(st))
    modules = {module.name for module in pkgutil.iter_modules(st.__path__)}
    for name in st.__all__:
        assert getattr(st, name) is not None
        if name not in ("batch", "parts", "procedural", "rules", "tasks", "tunnel"):  # modules by intention
            assert name not in modules  # its import would hide the name
    with pytest.raises(AttributeError, match="has no attribute 'moon'"):
        st.moon  # noqa: B018


def test_what_the_package_offers_can_be_pickled():
    for value in (st.LogUniform(1.0, 2.0), st.AutoReset, st.make, st.SubterraError):
        assert pickle.loads(pickle.dumps(value)) == value


PACKAGE = Path(subterra_jax.__file__).parent


def run(*words: str, path: Path = PACKAGE.parent, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "subterra_jax", *words],
        capture_output=True, text=True, timeout=120, check=False, env={**os.environ, "PYTHONPATH": str(path), **env},
        cwd="/",
    )  # fmt: skip


def test_tasks_are_listed_and_help_fits_a_screen():
    assert run("tasks").stdout.split() == list(list_tasks())
    help_page = run("--help").stdout
    assert all(name in help_page for name in COMMANDS)
    assert len(help_page.splitlines()) <= 24


def test_a_command_is_run_with_its_words_from_anywhere(tmp_path):
    done = run("record", "--task", "NoSuch-v1", "--out", str(tmp_path / "x.mcap"))
    assert done.returncode == 2
    assert "NoSuch-v1" in done.stderr
    assert "--length" in run("survey", "--help").stdout


@pytest.mark.parametrize(("words", "part"), [(["tain"], "train"), (["train"], "checkout")])
def test_what_cannot_be_run_is_said_in_one_sentence(tmp_path, words, part):
    (tmp_path / "subterra_jax").symlink_to(PACKAGE)  # as a wheel lays it out, without the other rooms
    if words == ["train"]:
        (tmp_path / "subterra_jax").unlink()
        shutil.copytree(PACKAGE, tmp_path / "subterra_jax", ignore=shutil.ignore_patterns("data", "__pycache__"))
    done = run(*words, path=tmp_path)
    assert done.returncode == 2
    assert part in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


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


def test_an_archive_that_was_cut_short_is_no_tunnel(tmp_path):
    cut = tmp_path / "cut.npz"
    cut.write_bytes(packaged("subterra-351.npz").read_bytes()[:50_000])
    with pytest.raises(st.TunnelError, match="cut short"):
        st.load_tunnel(cut)


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
    for outcome, says in ((int(number) - 1, "older .*--overwrite"), (int(number) + 1, "newer .* --upgrade")):
        facts.write_text(json.dumps({**json.loads(facts.read_text()), "schema": f"{name}/{outcome}"}))
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


def test_the_command_becomes_the_module_that_it_names(monkeypatch, capsys):
    ran, _ = [], monkeypatch.setenv("PYTHONPATH", "elsewhere")
    monkeypatch.setattr(os, "execve", lambda program, words, env: ran.append((words[1:], env["PYTHONPATH"])))
    main(["view", "--task", "StopAt"])
    path = f"{Path(st.__file__).parents[1]}{os.pathsep}elsewhere"
    assert ran == [(["-m", "subterra_jax.viewer", "--task", "StopAt"], path)]
    monkeypatch.setitem(COMMANDS, "demo", ("benchmarks.nowhere", "is not here"))
    assert (main(["demo"]), main(["tasks"])) == (2, 0)
    assert capsys.readouterr().out.split()[:2] == ["Subterra/Traverse-v1", "Subterra/TraverseShort-v1"]


def test_a_scene_brings_its_tunnel_and_goes_with_no_other(tmp_path):
    (tmp_path / "scene.xml").touch()
    assert [named("metro", None), named(None, None)] == ["metro", None]
    assert {named(None, place) for place in (tmp_path, tmp_path / "scene.xml")} == {tmp_path / "tunnel.npz"}
    for tunnel, scene, said in (("metro", tmp_path, "not both"), (None, tmp_path / "no", "no such scene")):
        with pytest.raises(st.TunnelError, match=said):
            named(tunnel, scene)
