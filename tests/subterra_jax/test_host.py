"""Host plumbing: command lines, exit statuses, files that appear whole or not at all, and the lazy package."""

import dataclasses
import os
import pickle
import pkgutil
import subprocess
import sys
import warnings

import pytest
import tyro

import subterra_jax as st
from subterra_jax.host.command import INPUT_ERRORS, parse, run_command
from subterra_jax.host.errors import OutputError, SubterraError
from subterra_jax.host.files import replace_file


@dataclasses.dataclass(frozen=True)
class Rare:
    """What hardly anybody sets."""

    depth: float = 1.0
    """Of the thing, m."""


@dataclasses.dataclass(frozen=True)
class Common:
    """Does a thing.

    Example: python -m thing --out here
    """

    out: str
    """Where."""
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
    assert "Of the thing" not in page
    assert page.endswith("--help-all shows further options: rare.\n")


def test_all_help_shows_every_group(capsys):
    page = shown(capsys, "--help-all")
    assert "--kind INT" in page
    assert "--rare.depth FLOAT" in page


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "missing: --out STR"),
        (["--out"], "Missing value for argument '--out'"),
        (["--out", "x", "--kind", "many"], "Error parsing --kind: invalid literal for int() with base 10: 'many'"),
        (["--out", "x", "--colour", "red"], "Unrecognized options: --colour, red"),
        (["--out", "x", "left", "over"], "Unrecognized options: left, over"),
    ],
)
def test_a_mistake_is_one_sentence_and_status_2(capsys, words, sentence):
    with pytest.raises(SystemExit) as ended:
        read(*words)
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith(f"error: {sentence}")
    assert told.endswith("; --help shows what there is\n")
    assert told.count("\n") == 1


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


@pytest.mark.parametrize("words", [["--help"], ["tasks"]])
def test_a_reader_that_leaves_early_is_no_error(words):
    """As `| head` does, once it has what it wants."""
    command = [sys.executable, "-m", "subterra_jax", *words]
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
