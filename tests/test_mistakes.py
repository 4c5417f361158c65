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

# Command line → what its sentence must say. `text.txt` is a file, `empty` a folder, `junk.*` are bytes of no kind,
# `tunnel` is a scene folder of such bytes, /proc a folder in which nobody can write.
MISTAKES = {
    "subterra_jax tain": "nothing is named tain; train is",
    "scene.limits moon": "no part 'moon' with thresholds; there are cleaning.",
    "scene.survey": "missing: --out",
    "scene.survey --out text.txt": "text.txt",
    "scene.survey --out o --truth moon": "'moon'",
    "scene.survey --out o --length nan": "length must be",
    "scene.survey --out o --seed -1": "seed must not be negative",
    "scene.survey --out o --point-rate 0": "point_rate must be",
    "scene.survey --out o --point-rate 100": "point_rate must be a multiple of 60",
    "scene.survey --out o --speed 0": "speed must lie between",
    "scene.survey --out o --truth metro --length 352": "length must be at most 351 m for truth metro",
    "scene.survey --out o --truth irregular --correlation 0.5": "correlation must lie between 1 and 4 m",
    "scene.survey --out o --scan-every 0": "scan_every must be at least 1",
    "scene.survey --out o --sensors avia avia": "sensors must differ",
    "scene.survey --out o --errors.lost 1.5": "errors.lost must lie between 0 and 1",
    "scene.survey --out o --errors.range-noise nan": "errors.range_noise must not be negative",
    "scene.build": "missing: INPUT",
    "scene.build none.bag --out o": "none.bag: no such file",
    "scene.build empty --out o": "empty: of no known kind",
    "scene.build junk.bag --out o": "junk.bag: not a whole ROS1 bag",
    "scene.build junk.laz --out o": "junk.laz: not a readable LAS cloud",
    "scene.build junk.bag --trajectory none.tum --out o": "none.tum: no such file",
    "scene.build junk.bag --calibration moon --out o": "moon: no calibration of that name",
    "scene.build junk.bag --out text.txt/x": "text.txt: is a file",
    "scene.build junk.bag --out /proc/no/x": "/proc/no/x: cannot be written",
    "scene.build junk.bag --out o --track.gauge -1": "--track.gauge must not be negative, got -1",
    "scene.build junk.bag --out o --scene.chunk-length 0": "--scene.chunk-length must be above 0",
    "benchmarks.board": "missing: --out",
    "benchmarks.board --out o --tasks Fly": "no task 'Fly'; there are",
    "benchmarks.board --out o --agents nobody": "no agent 'nobody'",
    "benchmarks.board --out o --splits dev": "there is no split 'dev'; there are train, val",
    "benchmarks.board --out o --sensor sonar": "no sensor 'sonar'; there are planar16, spin16x64",
    "benchmarks.board --out o --tunnels 0": "tunnels must be at least 1, got 0",
    "benchmarks.board --out o --memory 0": "memory must be above 0, got 0",
    "benchmarks.board --out o --report-only": "holds no cell of these tunnels",
    "benchmarks.board --out o --splits": "there is nowhere to drive: name splits or further tunnels",
    "benchmarks.board --out o --splits --further none.npz": "none.npz: no such tunnel file",
    "benchmarks.board --out text.txt/x": "text.txt: is a file",
    "benchmarks.draw moon": "nothing to draw is named 'moon'; there are scene, film",
    "benchmarks.records": "say one of render, check, keep, compare",
    "benchmarks.records keep none.json": "none.json: holds no records",
    "benchmarks.records compare none.json": "none.json: holds no records",
    "train": "missing: --out",
    "train --out o --preset abacus": "unknown preset 'abacus'",
    "train --out o --minibatches 7": "cannot be divided into minibatches = 7",
    "train --out o --auxiliary": "auxiliary = True is for memory = gru or along, and memory = none does not read it",
    "train --out o --map": "map = True is for memory = along, and memory = none does not read it",
    "train --out o --frames 8": "frames = 8 is for memory = stack or along, and memory = none does not read it",
    "train --out o --memory stack --cell 8": "cell = 8 is for memory = gru, and memory = stack does not read it",
    "train --out o --memory along --map --front wide": "map = True is for front = match, and front = wide",
    "train --out o --motion b2 --sensor vlp16": "sensor = vlp16 is not for motion = b2; with it, it is planar16",
    "train --out o --begin-from locate-transformer": "begin_from = locate-transformer: a localiser, and memory = none",
    "train --out o --begin-from TraverseShort-v1 --hidden 7": "begin_from = TraverseShort-v1 has another network:",
    "train --out o --begin-from nobody": "begin_from = nobody: nobody: no such policy",
    "train --out o --task Subterra/Traverse-v1 --memory gru --auxiliary": "auxiliary = True asks for the way to a goal",
    "train --out o --task Subterra/Traverse-v1 --memory along": "memory = along is for tasks that ask to stop or",
    "train --out o --task Subterra/TraverseShort-v1 --unroll 600": "must be shorter than an episode of Subterra/Trav",
    "train --out o --task StopAt-v7": "its id is Subterra/StopAt-v1",
    "train --out o --tunnel junk.npz": "junk.npz: not a readable .npz archive (it is no zip file",
    "train --out o --tunnel empty": "empty: not a readable .npz archive (it is a folder without a tunnel.npz)",
    "train --out o --lining velvet": "no lining 'velvet'",
    "train --out o --steps 0": "steps must be at least 1, got 0",
    "train --out o --learning-rate nan": "learning_rate must be positive, got nan",
    "train --out o --evaluation-episodes 501": "evaluation_episodes must be at most 500",
    "train --out text.txt/x": "text.txt: is a file",
    "train --out /proc/no/x": "/proc/no/x: cannot be written",
    "train --out o --memory tape": "unknown memory 'tape'",
    "train --out o --memory gru --begin-from junk.safetensors": "damaged policy",
    "train.evaluate": "a task or a policy must be named",
    "train.evaluate --policy none": "none: no such policy",
    "train.evaluate --policy empty": "empty: holds no policy.safetensors",
    "train.evaluate --policy Traverse-v1 --episodes 0": "episodes must be at least 1",
    "train.evaluate --policy Traverse-v1 --episodes 501": "episodes must be at most 500",
    "train.evaluate --policy Traverse-v1 --lining velvet": "no lining 'velvet'",
    "train.evaluate --policy Traverse-v1 --task Subterra/StopAt-v1": "has learnt Subterra/Traverse-v1 (to cover)",
    "train.evaluate --policy Traverse-v1 --task Subterra/StopAt-v7": "its id is Subterra/StopAt-v1",
    "train.release none --out o.safetensors": "none: no such policy",
    "train.release empty --out o.txt": "o.txt: must end in .safetensors",
    "train.release empty --out text.txt/o.safetensors": "text.txt: is a file",
    "scene.export empty --to glb": "empty: not a scene folder",
    "scene.export empty --to moon": "'moon'",
    "scene.export tunnel --to usd --out text.txt": "text.txt: must end in .usda",
    "train.walk --out o --robots 0": "robots must be at least 1",
    "train.walk --out o --scene empty": "empty/tunnel.npz: no such tunnel file",
    "train.walk --out o --release text.txt/x.safetensors": "text.txt: is a file",
    "train.curve": "no run folder was named",
    "train.curve empty": "empty: no readable episodes.csv",
    "train.curve empty --out text.txt/x.png": "text.txt: is a file",
    "train.curve empty --out x.xyz": "x.xyz: must end in .png",
    "benchmarks.fidelity moon": "moon",
    "benchmarks.fidelity run --scene none --out o": "none: no such file or folder",
    "benchmarks.fidelity run --scene empty --out o": "empty: is no scene folder",
    "benchmarks.fidelity run --scene tunnel --seed -1 --out o": "seed must not be negative",
    "benchmarks.fidelity run --scene tunnel --processes 0 --out o": "processes must be at least 1, got 0",
    "benchmarks.fidelity run --metrics none.py --out o": "none.py: cannot be read",
    "benchmarks.fidelity run --scene tunnel --out text.txt": "text.txt: is a file",
    "benchmarks.fidelity controls --scene tunnel --only N999 --out o": "no control 'N999'",
    "benchmarks.fidelity controls --scene tunnel --processes 0 --out o": "processes must be at least 1",
    "benchmarks.fidelity windows --scene none --out o": "none: no such file or folder",
    "benchmarks.fidelity faults --scene tunnel --draw -1 --out o": "draw must not be negative",
    "benchmarks.fidelity faults --scene tunnel --kinds ghost --out o": "no size of 'ghost' is asked for",
    "benchmarks.fidelity split junk.bag --out o": "junk.bag",
    "benchmarks.dirty empty --out o": "empty: no NAME_truth.npz",
    "benchmarks.slam": "Expected one of {arena, board, score}",
    "benchmarks.slam arena": "missing: --out",
    "benchmarks.slam arena --out o --courses moon": "no course 'moon'; there are walls-smooth",
    "benchmarks.slam arena --out o --distance nan": "distance must lie between 5 and 500 m, got nan",
    "benchmarks.slam arena --out text.txt": "text.txt",
    "benchmarks.slam arena --out o --courses": "nothing to record: courses and formats must name at least one",
    "benchmarks.slam arena --out o --seed -1": "seed must be at least 0, got -1",
    "benchmarks.slam board --sets empty --jobs 0 --out o": "jobs must be at least 1, got 0",
    "benchmarks.slam board --sets empty x/empty --out o": "sets must differ in the last part of their names",
    "benchmarks.slam board --sets empty --out o": "empty: holds no recordings",
    "benchmarks.slam board --sets empty --out o --programs moon": "no program 'moon'; there are wheel-odometry",
    "benchmarks.slam board --out o": "sets and programs must name at least one",
    "benchmarks.slam score --estimate --truth empty": "estimate must name at least one",
    "benchmarks.slam score --estimate junk.tum --truth junk.tum": "junk.tum",
    "benchmarks.throughput --seconds 0": "--seconds must be positive",
    "benchmarks.throughput --seed -1": "--seed must be at least 0",
    "benchmarks.throughput --n 0": "at least 1 environment, got 0",
    "benchmarks.throughput --steps 0": "--steps",
    "benchmarks.throughput --task Subterra/StopAt-v7 --peers none": "its id is Subterra/StopAt-v1",
    "benchmarks.throughput --n 2 --peers none --sensor nowhere": "no sensor 'nowhere'",
    "benchmarks.throughput --n 2 --peers none --lining velvet": "velvet",
    "benchmarks.throughput --n 2 --tunnel open:cast:train:0-1 --peers jaxnav": "--peers",
    "benchmarks.demo --length nan --out o": "length must be",
    "benchmarks.demo --out text.txt": "text.txt: is a file",
    "benchmarks.b2_traverse --coverage nan": "coverage must be above 0 and at most 1, got nan",
    "benchmarks.b2_traverse --policy Traverse-v1": "which is no gait",
    "benchmarks.b2_traverse --out empty": "empty: is a folder, not a file",
    "benchmarks.rewrite none.bag --out o": "none.bag: cannot be read",
    "benchmarks.recordings --count 0 --out o": "count must be at least 1, got 0",
    "benchmarks.draw scene none": "none",
    "benchmarks.draw scene tunnel --width -5": "width must be at least 1, got -5",
    "benchmarks.draw scene tunnel --out text.txt/x.png": "text.txt: is a file",
    "subterra_jax.viewer --seed x": "invalid int value: 'x'",
    "subterra_jax.viewer --sensor radar": "no sensor 'radar'; there are planar16",
    "subterra_jax.viewer --tunel metro": "nothing is named --tunel; --tunnel is",
    "benchmarks.fidelity rnu": "nothing is named rnu; run is",
    "scene.build --trajectry=a.tum": "nothing is named --trajectry; --trajectory is",  # before what is missing
    "subterra_jax tasks --tunel x": "unrecognized arguments: --tunel x",
    "subterra_jax.viewer --scene nowhere": "nowhere: no such scene folder",
    "subterra_jax.viewer --tunnel metro --scene s": "either --scene or --tunnel",
    "subterra_jax.viewer --task B2Walk": "Subterra/B2Walk-v1 has no episode to show",
    "subterra_jax.viewer --driver nobody --tunnel control": "no agent 'nobody'; there are",
    "subterra_jax.viewer --lining velvet --tunnel control": "tunnel 'control' has no lining 'velvet'",
    "subterra_jax.viewer --seed -1": "seed must be 0 to",
    "subterra_jax.viewer --steps 0": "steps must be at least 1",
    "subterra_jax.viewer --out a.htm": "a.htm: must end in .html",
    "subterra_jax.viewer --task Subterra/StopAt-v7": "its id is Subterra/StopAt-v1",
    "subterra_jax.viewer --out /proc/no/x.html": "/proc/no: cannot be written",
    "subterra_jax.viewer --tunnel junk.npz": "junk.npz: ",
    "subterra_jax.recorder": "missing: --out",
    "subterra_jax.recorder --out o --agent nobody": "no agent 'nobody'; there are random",
    "subterra_jax.recorder --out o --steps 0": "steps must be at least 1, got 0",
    "subterra_jax.recorder --out o --seed -1": "seed must be at least 0, got -1",
    "subterra_jax.recorder --out o --tunnel no.npz": "no.npz: no such tunnel file",
    "subterra_jax.recorder --out o --lining velvet": "has no lining 'velvet'",
    "subterra_jax.recorder --out o --task Subterra/StopAt-v7": "its id is Subterra/StopAt-v1",
    "subterra_jax.recorder --out o --agent policy:junk.safetensors": "damaged policy",
    "subterra_jax.recorder --out o --episode 500": "500",
    "subterra_jax.recorder --out text.txt/x": "text.txt: is a file",
    "subterra_jax.recorder --out o --truth text.txt": "text.txt: exists already",
}
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


@pytest.mark.parametrize(
    ("library", "words", "says"),
    [
        ("rosbags", "scene.build x --out o", "rosbags is not installed: pip install -e '.[recordings]'"),
        pytest.param(
            "orbax", "train --out o", "orbax.checkpoint is not installed", marks=pytest.mark.slow
        ),
        pytest.param(
            "gudhi", "benchmarks.fidelity run", "gudhi is not installed", marks=pytest.mark.slow
        ),
        pytest.param(
            "tensorboardX", "train --tensorboard --out o", "pip install 'subterra-jax[logs]'",
            marks=pytest.mark.slow,
        ),
        pytest.param("viser", "subterra_jax.viewer", "pip install 'subterra-jax[viewer]'", marks=pytest.mark.slow),
        pytest.param("tyro", "subterra_jax.recorder --out o", "pip install tyro", marks=pytest.mark.slow),
        pytest.param(
            "rosbags", "subterra_jax.recorder --out o", "pip install rosbags", marks=pytest.mark.slow
        ),
    ],
)  # fmt: skip
def test_a_library_that_is_missing_is_named_with_what_brings_it(library, words, says, desk):
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
    require_libraries("late", "export", "no_such_library")
    print("went on")
if __name__ == "__main__":
    main()
"""


@pytest.mark.parametrize(
    ("words", "status"), [("-m late", 2), ("-mlate", 2), ("late.py", 0), ("-c import\tlate;late.main()", 0)]
)
def test_a_library_asked_for_within_main_ends_the_command_alone(words, status, desk):
    """Whoever imports the module, or runs it as a file, has to go on: the sentence is for the command."""
    (desk / "late.py").write_text(LATE)
    done = subprocess.run(
        [sys.executable, *words.split(" ")], cwd=desk, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == status, done.stderr
    assert ("no_such_library is not installed: pip install -e '.[export]'" in done.stderr) == (status == 2)
    assert done.stdout == ("" if status else "went on\n")


def test_a_package_run_with_its_flag_in_one_word_names_what_it_lacks(desk):
    (desk / "early").mkdir()
    (desk / "early" / "__init__.py").write_text(LATE.replace('"late"', '"early"') + "main()\n")
    (desk / "early" / "__main__.py").write_text("")
    done = subprocess.run(
        [sys.executable, "-mearly"], cwd=desk, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
