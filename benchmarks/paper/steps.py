"""Steps before the figures: survey, scene and training, each made once by the users' own commands."""

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.command import BenchmarkError
from benchmarks.fidelity.files import file_hash, write_json

TASK = "Subterra/TraverseShort-v1"
SEEDS = (0, 1, 2, 3, 4)
SURVEY_FILES = ("survey.bag", "groundtruth.tum", "survey_os1.bag", "groundtruth_os1.tum")
SCENE_FILES = ("scene.xml", "bore.npz", "tunnel.npz", "cloud.ply", "manifest.json")
_RUN_FILES = ("config.json", "episodes.csv")
_INTERRUPTED = 130  # what every command of the project ends with after Ctrl-C
_MARK = "subterra.figure-step/1"


@dataclass(frozen=True)
class Step:
    """A command that makes a folder.

    Attributes:
        name: Name in messages.
        words: Words of the command after `python -m`.
        out: Output folder.
        files: Files below it that a finished step has.
        inputs: Input files; the step is run again when one changes.
        again: Words added to resume an interrupted run of the same words.
    """

    name: str
    words: tuple[str, ...]
    out: Path
    files: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    again: tuple[str, ...] = ()

    @property
    def mark(self) -> Path:
        """Path of the file that keeps the words of the step and whether it finished."""
        return self.out.parent / f"{self.out.name}.step.json"


def survey_step(out: Path, length: float, seed: int) -> Step:
    """Returns the step that simulates a survey on the real metro's alignment, with an OS1 held out beside the Avia."""
    words = f"scene.survey --truth metro --length {length:g} --seed {seed} --sensors avia os1 --scan-every 10 --out"
    return Step("survey", (*words.split(), str(out)), out, SURVEY_FILES)


def scene_step(out: Path, survey: Path, name: str, provenance: str) -> Step:
    """Returns the step that builds the scene from the Avia alone."""
    given = ("--trajectory", str(survey / "groundtruth.tum"), "--provenance", provenance, "--name", name)
    words = ("scene.build", str(survey / "survey.bag"), *given, "--out", str(out))
    return Step("scene", words, out, SCENE_FILES, inputs=(survey / "groundtruth.tum",))


def training_step(out: Path, scene: Path) -> Step:
    """Returns the step that trains five seeds of T0 in the reconstructed bore."""
    seeds = tuple(str(seed) for seed in SEEDS)
    words = ("--task", TASK, "--tunnel", str(scene / "tunnel.npz"), "--seeds", *seeds, "--preset", "cpu")
    files = ("seeds.json", *(f"seed-{seed}/{file}" for seed in SEEDS for file in _RUN_FILES))
    inputs = (scene / "tunnel.npz",)
    return Step("training", ("train", *words, "--out", str(out)), out, files, inputs, again=("--resume",))


def require(folder: Path, files: tuple[str, ...]) -> None:
    """Checks the files; raises `BenchmarkError` naming the first file that is missing in a folder."""
    for file in files:
        if not (folder / file).exists():
            raise BenchmarkError(f"{folder / file}: no such file")


def is_done(step: Step) -> bool:
    """Returns whether the step finished with the same words and its files are still there."""
    return _read_mark(step) == "done" and all((step.out / file).exists() for file in step.files)


def make(step: Step) -> None:
    """Runs a step unless it is done; its progress goes to stderr.

    Raises:
        BenchmarkError: It failed.
        KeyboardInterrupt: It was interrupted.
    """
    if is_done(step):
        print(f"{step.name}: {step.out} is there", flush=True)
        return
    begun = _read_mark(step) == "begun"
    words = (*step.words, *(step.again if begun and _can_resume(step) else _overwrite(step)))
    print(f"{step.name}: python -m {' '.join(words)}", flush=True)
    step.out.parent.mkdir(parents=True, exist_ok=True)
    _write_mark(step, "begun")
    started = time.monotonic()
    status = subprocess.run([sys.executable, "-m", *words], stdout=sys.stderr, check=False).returncode
    if status == _INTERRUPTED:
        raise KeyboardInterrupt
    missing = [file for file in step.files if not (step.out / file).exists()]
    if status or missing:
        why = f"ended with status {status}" if status else f"left no {missing[0]}"
        raise BenchmarkError(f"{step.out}: python -m {words[0]} {why}")
    _write_mark(step, "done")
    print(f"{step.name}: {time.monotonic() - started:.0f} s", flush=True)


def _overwrite(step: Step) -> tuple[str, ...]:
    """Returns the option without which training refuses to replace another run."""
    return ("--overwrite",) if step.again else ()


def _can_resume(step: Step) -> bool:
    return all((step.out / f"seed-{seed}" / "checkpoint").exists() for seed in SEEDS)


def _read_mark(step: Step) -> str | None:
    """Returns `begun` or `done` if the mark has the same words and inputs, else `None`."""
    try:
        mark = json.loads(step.mark.read_text())
        same = mark["words"] == list(step.words) and mark["inputs"] == _hashes(step)
        return str(mark["state"]) if same else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _write_mark(step: Step, state: str) -> None:
    write_json(step.mark, {"schema": _MARK, "state": state, "words": list(step.words), "inputs": _hashes(step)})


def _hashes(step: Step) -> dict[str, str]:
    return {path.name: file_hash(path) for path in step.inputs if path.exists()}
