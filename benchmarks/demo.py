"""`make demo`: from a simulated survey to a scene, a trained agent and a report, by the users' own commands."""

import io
import json
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.command import run_main, run_module
from benchmarks.report import write_report
from benchmarks.truth import compare, load_truth
from scene.survey.config import SurveyConfig, check_survey
from subterra_jax.host.files import require_folder
from subterra_jax.pictures.renderer import import_mujoco

TASK = "Subterra/TraverseShort-v1"


@dataclass(frozen=True)
class DemoConfig:
    """Survey → bag → scene → MuJoCo and MJX → training on the reconstructed bore → report.

    Example: python -m benchmarks.demo --length 60 --out out/demo
    """

    out: Path = Path("out/demo")  # Output folder.
    length: float = 60.0  # Length of the simulated tunnel, m.
    seed: int = 0  # Seed for survey and training.
    point_rate: int = 240_000  # Points per second of the simulated LiDAR.


@contextmanager
def timed(seconds: dict[str, float], name: str, text: str) -> Iterator[None]:
    """Announces a stage, times it, and keeps its wall-clock time under `name`."""
    print(f"\n=== {text}", flush=True)
    started = time.monotonic()
    yield
    seconds[name] = time.monotonic() - started
    print(f"--- {seconds[name]:.1f} s", flush=True)


def _run(module: str, *words: object) -> None:
    """Runs a command; one that fails ends the demo."""
    if status := run_module(module, *words).status:
        sys.exit(status)


def step_in_mujoco_and_mjx(scene: Path) -> dict[str, Any]:
    """Drives the rover of a scene for 4 s in MuJoCo and steps it in MJX; returns versions, sizes and distance, m."""
    import jax
    import numpy as np

    mujoco = import_mujoco("the demo")
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):  # a message about the optional Warp backend
        from mujoco import mjx

    model = mujoco.MjModel.from_xml_path(str(scene / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start, data.ctrl[:] = data.body("scout").xpos.copy(), (0.8, 0.0)
    mujoco.mj_step(model, data, round(4.0 / model.opt.timestep))
    started = time.monotonic()
    stepped = jax.jit(mjx.step)(mjx.put_model(model), mjx.make_data(model))
    finite = bool(np.isfinite(np.asarray(stepped.qpos)).all())
    return {
        "mujoco_version": mujoco.__version__,
        "geoms": int(model.ngeom),
        "mesh_faces": int(model.nmeshface),
        "rover_metres": float(np.linalg.norm(data.body("scout").xpos - start)),
        "mjx_compile_seconds": time.monotonic() - started,
        "mjx_state_finite": finite,
    }


def main(config: DemoConfig) -> None:
    """Runs every stage and prints the path of the report.

    Raises:
        ValueError: A number is out of range.
        SubterraError: The folder cannot be written.
    """
    out, started, seconds = config.out, time.monotonic(), dict[str, float]()
    require_folder(out)
    survey, scene, run = (out / name for name in ("survey", "scene", "training"))
    check_survey(SurveyConfig(survey, length=config.length, seed=config.seed, point_rate=config.point_rate))
    bag, seed = survey / "survey.bag", ("--seed", config.seed)
    task = ("--task", TASK, "--tunnel", scene / "tunnel.npz")
    with timed(seconds, "survey", f"1/5 Simulating a survey of {config.length:g} m (a ROS1 bag in GEODE's layout)"):
        size = ("--length", config.length, "--point-rate", config.point_rate)
        _run("scene.survey", *size, *seed, "--out", survey)
    with timed(seconds, "build", "2/5 Reconstructing the bore from the bag, poses given"):
        poses = ("--trajectory", survey / "groundtruth.tum")
        _run("scene.build", bag, *poses, "--provenance", "simulated", "--out", scene)
    # One core each: the trainer compiles on one for most of its time, and so does MJX.
    with ThreadPoolExecutor(1) as beside:
        with timed(seconds, "train", f"3/5 Training on the reconstructed bore ({TASK}); MuJoCo and MJX load the scene"):
            loading = beside.submit(step_in_mujoco_and_mjx, scene)
            _run("train", *task, *seed, "--overwrite", "--out", run)
            loaded = loading.result()
            print(", ".join(f"{name} {value}" for name, value in loaded.items()))
        with timed(seconds, "film", "4/5 Filming what was learnt: the rover by physics, in the scene just built"):
            judging = beside.submit(compare, scene, truth := load_truth(survey / "truth.json"))
            words = ("--motion", "rover", "--scene", scene, "--pictures", 40, "--out", out / "film.webp")
            _run("benchmarks.draw", "film", "--task", TASK, *seed, "--agent", run, *words)
    with timed(seconds, "report", "5/5 Writing the report"):
        summary: dict[str, Any] = {
            "provenance": "simulated",
            "task": TASK,
            "length": float(truth.station[-1] - truth.station[0]),
            **judging.result().figures(),
            **_training_figures(run),
            **loaded,
            "stage_seconds": seconds,
            "seconds": time.monotonic() - started,
        }
        report = write_report(out, summary, truth)
        (out / "summary.json").write_text(json.dumps(summary, indent=2, sort_keys=True) + "\n")
    print(f"\n{len(seconds)} stages in {time.monotonic() - started:.0f} s: {report}")


def _training_figures(run: Path) -> dict[str, Any]:
    last = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
    evaluation = json.loads((run / "evaluation.json").read_text())
    return {
        "coverage_mean_100": last["coverage_mean_100"],
        "success_mean_100": last["success_mean_100"],
        "train_steps": last["step"],
        "train_episodes": last["episodes"],
        **{f"evaluation_{name}": evaluation[name] for name in ("episodes", "coverage", "success", "offset", "time")},
    }


if __name__ == "__main__":
    sys.exit(run_main("demo", DemoConfig, main))
