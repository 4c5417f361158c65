"""Makes the paper's figures at print size; a finished figure is not made again."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.command import BenchmarkError, run_main
from benchmarks.fidelity.files import file_hash
from benchmarks.paper import figures, learning, sheet, steps
from benchmarks.paper.material import Material, read_truth
from benchmarks.paper.sheet import Drawing
from scene.survey.config import SurveyConfig, check_survey
from subterra_jax.host.files import require_folder

SURVEY_FIGURES: dict[int, Callable[[Material], Drawing]] = {
    1: figures.draw_bore_view,
    2: figures.draw_pipeline,
    3: figures.draw_occupancy,
}
LEARNING = 4
_LIBRARIES = ("matplotlib", "mujoco", "numpy", "jax")


@dataclass(frozen=True)
class PaperConfig:
    """Figures 1 to 4 of the paper as PDF and PNG, each with its data (CSV) and provenance (JSON).

    Example: python -m benchmarks.paper --out out/figures

    Attributes:
        out: Output folder; finished figures and steps in it are not made again.
        figures: Numbers: 1 recording and bore, 2 pipeline, 3 occupancy, 4 learning curves.
        length: Length of the simulated survey if none is given, m.
        seed: Seed for that survey.
        survey: Survey folder to use instead: `survey.bag`, `survey_os1.bag` and their trajectories.
        scene: Scene folder built from that survey, instead of building it.
        runs: Folder with run folders `seed-*` of `train` on T0, instead of training five seeds.
        provenance: Line below figures 1 to 3; read from the scene's manifest if not given.
    """

    out: Path = Path("out/figures")
    figures: tuple[int, ...] = (1, 2, 3, 4)
    length: float = 60.0
    seed: int = 0
    survey: Path | None = None
    scene: Path | None = None
    runs: Path | None = None
    provenance: str | None = None


def check(config: PaperConfig) -> None:
    """Refuses settings that cannot be drawn.

    Raises:
        BenchmarkError: There is no such figure, or the given folders do not fit together.
    """
    known = (*SURVEY_FIGURES, LEARNING)
    if not config.figures:
        raise BenchmarkError(f"figures must name at least one of {', '.join(map(str, known))}")
    for number in config.figures:
        if number not in known:
            raise BenchmarkError(f"no figure {number}; there are {', '.join(map(str, known))}")
    if config.scene is not None and config.survey is None:
        raise BenchmarkError(f"scene {config.scene} needs the survey that it was built from, for its held-out LiDAR")
    for path in (config.survey, config.scene, config.runs):
        if path is not None and not path.is_dir():
            raise BenchmarkError(f"{path}: no such folder")
    if config.survey is None:
        check_survey(SurveyConfig(config.out / "survey", truth="metro", length=config.length, seed=config.seed))
    else:
        steps.require(config.survey, steps.SURVEY_FILES)
    if config.scene is not None:
        steps.require(config.scene, steps.SCENE_FILES)
    if config.runs is not None and LEARNING in config.figures:
        learning.find_runs(config.runs)
    require_folder(config.out)


def make(config: PaperConfig) -> None:
    """Makes missing inputs and figures, step by step.

    Raises:
        SubterraError: A step failed, or an input is missing or broken.
    """
    check(config)
    config.out.mkdir(parents=True, exist_ok=True)
    material = None
    if set(config.figures) & set(SURVEY_FIGURES) or config.runs is None:
        material = _prepare_survey(config)
    with sheet.style():
        for number in config.figures:
            if number == LEARNING:
                _make_learning_figure(config, material)
            elif material is not None:
                inputs = _hashes([material.scene / "manifest.json", material.survey / "groundtruth_os1.tum"])
                draw = partial(SURVEY_FIGURES[number], material)
                _make_figure(config, number, _provenance(config, material), inputs, draw)


def _prepare_survey(config: PaperConfig) -> Material:
    """Returns survey and scene, made first if missing."""
    survey, scene = config.survey or config.out / "survey", config.scene or config.out / "scene"
    if config.survey is None:
        steps.make(steps.survey_step(survey, config.length, config.seed))
    if config.scene is None:
        name = survey.name if config.survey else f"subterra-{config.length:g}"
        provenance = "simulated" if read_truth(survey) else "measured"
        steps.make(steps.scene_step(scene, survey, name, provenance))
    material = Material(survey, scene)
    material.check()
    return material


def _make_learning_figure(config: PaperConfig, material: Material | None) -> None:
    folder = config.runs or config.out / "training"
    if config.runs is None and material is not None:
        steps.make(steps.training_step(folder, material.scene))
    runs = learning.find_runs(folder)
    inputs = _hashes([run / name for run in runs for name in ("config.json", "episodes.csv")])
    _make_figure(config, LEARNING, learning.provenance(runs), inputs, partial(learning.draw, runs))


def _make_figure(
    config: PaperConfig, number: int, provenance: str, inputs: dict[str, str], draw: Callable[[], Drawing]
) -> None:
    """Draws one figure, unless it is there from the same inputs and code."""
    name = f"fig{number}"
    facts = {
        "provenance": provenance,
        "inputs": inputs,
        "versions": {library: version(library) for library in _LIBRARIES},
    }
    key = sha256(json.dumps([number, facts, sheet.code_hash()], sort_keys=True).encode()).hexdigest()
    if sheet.is_made(config.out, name, key):
        print(f"figure {number}: {config.out / name}.pdf is there", flush=True)
        return
    print(f"figure {number}: drawing", flush=True)
    sheet.save(draw(), config.out, name, {**facts, "key": key})
    print(f"figure {number}: {config.out / name}.pdf", flush=True)


def _provenance(config: PaperConfig, material: Material) -> str:
    """Returns one line that names the survey and says whether it is simulated."""
    if config.provenance is not None:
        return config.provenance
    if not material.simulated:
        return f"Survey {material.survey.name}, {material.manifest.get('input_provenance')}."
    facts = read_truth(material.survey)
    origin = f"{facts['truth']}, {facts['length']:g} m, seed {facts['seed']}; python -m scene.survey" if facts else ""
    return f"Simulated survey ({origin or material.survey.name}); no real recording."


def _hashes(paths: list[Path]) -> dict[str, str]:
    """Returns the SHA-256 of files by their last two names."""
    hashes: dict[str, Any] = {}
    for path in paths:
        if not path.exists():
            raise BenchmarkError(f"{path}: no such file")
        hashes[f"{path.parent.name}/{path.name}"] = file_hash(path)
    return hashes


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 0 once every figure is there, 2 for a user's mistake, 130 after Ctrl-C."""
    again = "interrupted; the same command goes on from here"
    return run_main("paper", PaperConfig, make, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
