"""`python -m scene.build INPUT --out DIR`: builds a scene folder from a recording."""

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import tyro

from scene.errors import FitError, RecordingError
from scene.judging.judge import DoubtError, Judgement
from scene.output import BuildConfig, write_scene_folder
from scene.poses.calibration import find_calibration
from scene.progress import Stages
from scene.reconstruct import Reconstruction, reconstruct
from scene.resume import Partial, partial_folder
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import replace_file, replace_folder, require_folder
from subterra_jax.host.loading import load_module

_POSITIVE = ("spacing", "voxel", "cutoff", "gauge", "length", "width", "height", "diameter", "size")


class SettingError(SubterraError):
    """A setting that no build can have."""


def check_settings(config: Any, prefix: str = "") -> None:
    """Refuses numbers that are negative or not finite in a tree of dataclasses; some may not be 0 either.

    `prefix` stands before the options' names. Raises `SettingError`, which names the option and its value.
    """
    for part in fields(config):
        value, name = getattr(config, part.name), f"{prefix}{part.name.replace('_', '-')}"
        if is_dataclass(value):
            check_settings(value, f"{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, (int, float)) and not isinstance(number, bool):
                check_number(name, number)


def check_number(name: str, value: float) -> None:
    """Refuses a number that is negative or not finite; `name` tells whether it may be 0. Raises `SettingError`."""
    if not math.isfinite(value):
        raise SettingError(f"--{name} must be a finite number, got {value}")
    if value < 0.0:
        raise SettingError(f"--{name} must not be negative, got {value:g}")
    if value == 0.0 and name.endswith(_POSITIVE):
        raise SettingError(f"--{name} must be above 0, got {value:g}")


_DEFAULT = BuildConfig()


def build(
    source: Path,
    out: Path,
    trajectory: Path | None = None,
    config: BuildConfig | None = None,
    control: Path | None = None,
    calibration: str | None = None,
    partial: Partial | None = None,
    reader: str | None = None,
) -> Reconstruction:
    """Reconstructs the tunnel in `source` and writes its scene folder whole, or not at all.

    Args:
        source: The input; see `scene.reconstruct`.
        out: Folder to write; a previous one is replaced once the new one is complete.
        trajectory: Poses for a bag, TUM.
        config: Settings; the defaults where not given.
        control: Positions for a bag, TUM.
        calibration: See `scene.poses.calibration.find_calibration`.
        partial: Place for partial results; beside `out` where not given.
        reader: File or module that registers a reader of the user's own.

    Raises:
        SubterraError: The input or a setting is at fault, or the output cannot be written.
    """
    config = config or BuildConfig()
    require_folder(out)
    check_settings(config)
    check_number("keep-every", 0.0 if partial is None else partial.every)
    mounts = find_calibration(calibration)
    if reader is not None:
        load_module(reader)
    started = time.monotonic()
    partial = partial or Partial(partial_folder(out))
    try:
        with Stages() as progress:
            result = reconstruct(source, trajectory, config.reconstruct, progress, control, mounts, partial)
        _print_time(started, f"bore: {result.bore.length:.2f} m, {result.facts['kind']}")
        print(_describe_stations(result), flush=True)
        with replace_folder(out) as folder:
            judgement = _write(folder, source, config.name or out.name, result, config)
            _print_time(started, f"scene: written and compiled by MuJoCo {mujoco.__version__}")
        partial.discard()
        _page_of_refusal(out).unlink(missing_ok=True)  # of an earlier try
    except (RecordingError, FitError) as error:
        partial.discard()  # the input is at fault, and would be again
        if isinstance(error, DoubtError) and error.page:
            raise _leave_page(error, out) from error
        raise
    finally:
        partial.close()
    print(judgement.summary(), flush=True)
    print(_tell_track(out), flush=True)
    for warning in judgement.warnings:
        print(f"warning: {warning.text}", file=sys.stderr, flush=True)
    print(f"{out / 'scene.xml'}")
    return result


def _describe_stations(result: Reconstruction) -> str:
    """Return where the stations begin and which way they grow, for people."""
    x, y, z = result.bore.position[0] + result.origin
    start = float(result.facts["chainage_start"])
    chainage = f", chainage {start:g} m" if start else ""
    return f"stations: 0 m{chainage} at ({x:.1f}, {y:.1f}, {z:.1f}); they grow {result.facts['chainage_grows']}"


def _tell_track(folder: Path) -> str:
    """Return where a scene's track comes from, and what to do where there is none that one may have looked for."""
    laid = str(json.loads((folder / "manifest.json").read_text())["track"]["laid"])
    return f"track: {laid}" + ("; --track standard lays one" if "no rails" in laid else "")


def _write(folder: Path, source: Path, name: str, result: Reconstruction, config: BuildConfig) -> Judgement:
    """Writes the scene folder; an error of the fit names the source."""
    try:
        return write_scene_folder(folder, name, result, config)
    except DoubtError as error:
        raise DoubtError(f"{source}: {error}", error.page) from error


def _page_of_refusal(out: Path) -> Path:
    """Return the place of the report on a build that was refused: beside its folder, which stays as it was."""
    return out.with_name(f"{out.name}-refused.html")


def _leave_page(error: DoubtError, out: Path) -> DoubtError:
    """Writes the report of a refused build; returns the error with the place of the report in its sentence."""
    with replace_file(_page_of_refusal(out)) as fresh:
        fresh.write_text(error.page, encoding="utf-8")
    return DoubtError(f"{error} ({_page_of_refusal(out)} shows why)")


def _print_time(started: float, text: str) -> None:
    print(f"[{time.monotonic() - started:6.1f} s] {text}", flush=True)


def command(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="input", metavar="INPUT")],
    /,
    out: Path,
    trajectory: Path | None = None,
    control: Path | None = None,
    calibration: str | None = None,
    reader: str | None = None,
    fresh: bool = False,
    keep_every: float = 5.0,
    config: Annotated[BuildConfig, tyro.conf.arg(name="")] = _DEFAULT,
) -> Callable[[], Reconstruction]:
    """Builds a scene from a recording.

    Example: python -m scene.build survey.bag --trajectory groundtruth.tum --out build/tunnel

    Args:
        source: A recording (ROS1 or ROS2 bag, MCAP, folder of timed scans), a registered cloud (PLY,
            PCD, LAS, LAZ, E57, XYZ, CSV, Parquet), or an as-built ring survey (CSV, XLSX).
        out: Folder to write; replaced only once the new scene is complete.
        trajectory: Poses of the LiDAR in TUM form (t x y z qx qy qz qw), for a bag; without it, LiDAR odometry.
        control: Positions of a prism in TUM form (quaternion zero, any order) that fix odometry's length.
        calibration: Mounts of prism and IMU: geode-gamma, geode-beta, …, a YAML file, or the prism's
            x,y,z in the LiDAR's axes, m.
        reader: Python file or module of your own that registers a reader.
        fresh: Start over, whatever a killed build got done.
        keep_every: Least time between two partial results, s.
        config: Settings.
    """
    results = Partial(partial_folder(out), fresh, keep_every)
    return partial(build, source, out, trajectory, config, control, calibration, results, reader)


def main() -> int:
    """Runs the command and returns its exit status."""
    np.seterr(all="ignore")
    wanted = parse(lambda words: tyro.cli(command, prog="python -m scene.build", args=words))

    def act() -> None:
        wanted()

    return run_command(act, "interrupted; the output is as it was, and the same command goes on from here")


if __name__ == "__main__":
    sys.exit(main())
