"""Mistakes of a user at a command line: one sentence, exit status 2, nothing half-written."""

import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
JUNK = bytes(range(256)) * 8
ROWS = [line for line in Path(__file__).with_name("mistakes.txt").read_text().splitlines() if not line.startswith("#")]
MISTAKES = dict(row.split(" => ") for row in ROWS)
COMMANDS = sorted({words.split()[0] for words in MISTAKES} - {"benchmarks.fidelity", "benchmarks.slam"}) + [
    f"benchmarks.fidelity{part}"
    for part in ("", " run", " controls", " split", " windows", " faults")
] + [f"benchmarks.slam{part}" for part in ("", " arena", " board", " score")]  # fmt: skip


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with things in it that are not what a command wants."""
    (tmp_path / "text.txt").write_text("hello\n")
    (tmp_path / "empty").mkdir()
    for ending in ("bag", "laz", "npz", "tum", "safetensors", "json"):
        (tmp_path / f"junk.{ending}").write_bytes(JUNK)
    (tmp_path / "tunnel" / "meshes").mkdir(parents=True)
    for name in ("scene.xml", "bore.npz", "tunnel.npz", "manifest.json", "meshes/lining.ply"):
        (tmp_path / "tunnel" / name).write_bytes(JUNK)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(words: list[str], monkeypatch: pytest.MonkeyPatch) -> object:
    """Runs `python -m WORDS` in this process; its exit status."""
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
    return ended.value.code


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of runpy: the tests have imported the module before
@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_one_sentence_and_status_2_and_leaves_nothing(words, desk, monkeypatch, capfd):
    before = sorted(desk.rglob("*"))
    assert run(shlex.split(words), monkeypatch) == 2
    output = capfd.readouterr().err
    assert output.startswith("error: ")
    assert output.count("\n") == 1, output
    assert MISTAKES[words] in output
    assert sorted(desk.rglob("*")) == before


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_a_screen_and_has_an_example(command, desk, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "100")
    words = command.split()
    assert run([*words, "--help"], monkeypatch) == 0
    page = capsys.readouterr().out
    assert page.count("\n") <= 45
    assert not re.findall(r"(?m)^  --\S+(?: [^a-z\s]\S*)*\s+\((?:default|required)", page), "an option without a word"
    assert max(map(len, page.splitlines())) <= 100
    assert f"python -m {command} " in " ".join(page.split("\n\n", 1)[1].split())


def test_no_command_is_left_out():
    mains = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
        for room in ("scene", "train", "benchmarks", "subterra_jax")
        for path in (ROOT / room).rglob("*.py")
        if '__name__ == "__main__"' in path.read_text()
    }
    assert mains == {command.split()[0] for command in COMMANDS}


BLOCKER = """
import os, sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == os.environ["BLOCKED"]:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Blocked())
"""


MISSING = {  # command: library that is not there, and what it says
    "scene.build x --out o": ("rosbags", "rosbags is not installed: pip install -e '.[recordings]'"),
    "train --out o": ("orbax", "orbax.checkpoint is not installed"),
    "benchmarks.fidelity run": ("gudhi", "gudhi is not installed"),
    "train --tensorboard --out o": ("tensorboardX", "pip install 'subterra-jax[logs]'"),
    "subterra_jax.viewer": ("viser", "pip install 'subterra-jax[viewer]'"),
    "subterra_jax.recorder --out tyro": ("tyro", "pip install tyro"),
    "subterra_jax.recorder --out o": ("rosbags", "pip install rosbags"),
}


@pytest.mark.parametrize("words", MISSING)
def test_a_library_that_is_missing_is_named_with_what_brings_it(words, desk):
    library, says = MISSING[words]
    (desk / "blocker").mkdir()
    (desk / "blocker" / "sitecustomize.py").write_text(BLOCKER)
    paths = {"PYTHONPATH": f"{desk / 'blocker'}{os.pathsep}{ROOT}", "BLOCKED": library}
    done = subprocess.run(
        [sys.executable, "-m", *words.split()], env={**os.environ, **paths}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert says in done.stderr
    assert not (desk / "o").exists()


LATE = """
from subterra_jax.host.command import require_libraries
def main():
    require_libraries(__name__.replace("__main__", "late"), "export", "no_such_library")
    print("went on")
if __name__ == "__main__":
    main()
"""


@pytest.mark.parametrize(
    ("words", "status"),
    [("-m late", 2), ("-mlate", 2), ("-mearly", 2), ("late.py", 0), ("-c import\tlate;late.main()", 0)],
)
def test_a_library_asked_for_within_main_ends_the_command_alone(words, status, desk):
    """Whoever imports the module, or runs it as a file, has to go on: the sentence is for the command."""
    (desk / "late.py").write_text(LATE)
    (desk / "early").mkdir()
    (desk / "early" / "__init__.py").write_text(LATE + "main()\n")
    (desk / "early" / "__main__.py").write_text("")
    done = subprocess.run(
        [sys.executable, *words.split(" ")], cwd=desk, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == status, done.stderr
    if words != "-mearly":
        assert ("no_such_library is not installed: pip install -e '.[export]'" in done.stderr) == (status == 2)
    assert done.stdout == ("" if status else "went on\n")
