"""`python -m scene.build INPUT --out DIR`: builds a scene folder from a recording, a cloud or a ring survey.

The pipeline, a package each, in this order: `reading` the input, `poses` of its scans, `cleaning` of what is not the
bore, `fitting` of axis, wall, lining and track, `judging` of the bore against all returns, `writing` of the folder.
`build` runs it, `reconstruct` its part up to the bore. Where a build was killed, the next goes on from the poses.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import mujoco
import tyro

from scene.cleaning.clean import clean_cloud, crop_cloud, turn_round
from scene.config import BuildConfig, ReconstructConfig, check_settings, check_words
from scene.errors import Code, FitError, RecordingError, require_input
from scene.fitting.lining import add_lining
from scene.fitting.rings import fit_ring_survey
from scene.fitting.section import fit_unfolded
from scene.fitting.trackseen import find_track, measure_gauge
from scene.inputs import hash_inputs
from scene.judging.judge import Judgement, JudgingConfig, Warned, judge_bore, require_trust
from scene.judging.page import render_page
from scene.judging.places import track_zone
from scene.judging.sanity import doubt_bore, doubt_layers, doubt_track
from scene.poses.calibration import UNCALIBRATED, Calibration, find_calibration
from scene.poses.kept import find_kept, forget_kept, keep_placed, load_kept
from scene.poses.place import Placed, place_cloud, place_recording
from scene.progress import Stages
from scene.reading.formats import describe, detect, load_reader
from scene.reading.ringsurvey import read_ring_survey
from scene.reading.tables import given_columns
from scene.writing.folder import Reconstruction, write_folder
from scene.writing.track import Track, describe_track, lay_track
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file, replace_folder, require_folder

_DEFAULT = BuildConfig()


def build(
    source: Path,
    out: Path,
    trajectory: Path | None = None,
    config: BuildConfig | None = None,
    control: Path | None = None,
    calibration: str | None = None,
    reader: str | None = None,
    more: tuple[Path, ...] = (),
) -> Reconstruction:
    """Reconstructs the tunnel in `source` and writes its scene folder whole, or not at all.

    Args:
        source: The input.
        out: Folder to write; a previous one is replaced once the new one is complete.
        trajectory: Poses for a bag, TUM.
        config: Settings; the defaults where not given.
        control: Positions for a bag, TUM.
        calibration: See `scene.poses.calibration.find_calibration`.
        reader: File or module that registers a reader of the user's own.
        more: Further bags of the same recording.

    Raises:
        SubterraError: The input or a setting is at fault, or the output cannot be written.
    """
    config = config or BuildConfig()
    name = config.name or out.name
    require_folder(out, "manifest.json")
    check_settings(config)
    check_words(config.name, config.date)
    mounts = find_calibration(calibration)
    if reader is not None:
        load_reader(reader)
    inputs = [path for path in (source, *more, trajectory, control) if path is not None and path.exists()]
    for path in inputs:
        if out.resolve() in path.resolve().parents:
            raise RecordingError(f"{path}: lies in {out}, which the scene would replace")
    kept = find_kept(out, inputs, (config.reconstruct.voxel, config.reconstruct.reading, mounts, reader))
    refused = out.with_name(f"{out.name}-refused.html")  # the report then; the folder stays as it was
    started = time.monotonic()
    try:
        with Stages() as progress:
            result = reconstruct(source, trajectory, config.reconstruct, progress, control, mounts, more, kept)
            _print_time(started, f"bore: {result.bore.length:.2f} m, {result.facts['kind']}")
            x, y, z = result.bore.position[0] + result.origin
            grow = result.facts["stations_grow"]
            print(f"stations: 0 m at ({x:.1f}, {y:.1f}, {z:.1f}); they grow {grow}", flush=True)
            with _naming(source):
                track = lay_track(result.bore, config.track, result.seen)
                judgement = judge(result, track, config.judging)
                _require_trust(name, result, judgement, config.judging.force)
                with replace_folder(out) as folder:
                    write_folder(folder, name, result, track, judgement, config)
            _print_time(started, f"scene: written and compiled by MuJoCo {mujoco.__version__}")
    except FitError as error:
        if error.page:
            with replace_file(refused) as fresh:
                fresh.write_text(error.page, encoding="utf-8")
            raise error.about(f"{error} ({refused} shows why)") from error
        forget_kept(out)
        raise
    forget_kept(out)
    refused.unlink(missing_ok=True)  # of an earlier try
    print(judgement.summary(), flush=True)
    laid = describe_track(track, result.seen)["laid"]
    print(f"track: {laid}" + ("; --track standard lays one" if "no rails" in laid else ""), flush=True)
    for warning in judgement.warnings:
        print(f"warning: {warning.text} [{warning.code}]", file=sys.stderr, flush=True)
    print(f"{out / 'scene.xml'}")
    return result


def reconstruct(
    source: Path,
    trajectory: Path | None,
    config: ReconstructConfig,
    progress: Stages,
    control: Path | None = None,
    calibration: Calibration = UNCALIBRATED,
    more: tuple[Path, ...] = (),
    kept: Path | None = None,
) -> Reconstruction:
    """Detects the kind of an input, of any format that `scene.reading.formats` knows, and builds its bore.

    Takes what `build` takes; `kept` is where the registered cloud of a recording is kept for a build that is killed.

    Raises:
        RecordingError: Unreadable, or of no known kind.
        FitError: No tunnel in it.
    """
    detected = detect(require_input(source), config.reading.format)
    kind, path, parts = detected.format.kind, detected.path, (config.voxel, config.reading, progress)
    for given, what in ((trajectory, "a trajectory"), (control, "control")):
        if given is not None and kind != "recording":
            raise RecordingError(f"{given}: {what} goes with a bag, but {source} is none")
    if more and kind != "recording":
        raise RecordingError(f"{more[0]}: several inputs are parts of one recording, but {source} is none")
    if control is not None and trajectory is not None:
        raise RecordingError(f"{control}: control is for a recording without a trajectory, but {trajectory} is given")
    with _naming(source):
        if kind == "rings":
            return _fit_rings(path, config, progress)
        placed = load_kept(kept) if kept is not None and kind == "recording" else None
        if kind == "cloud":
            placed = place_cloud(path, *parts)
        elif placed is None:
            placed = place_recording(path, trajectory, control, calibration, *parts, more)
            if kept is not None:
                keep_placed(kept, placed)
        try:
            return _fit_cloud(placed, config, progress)
        except FitError as error:  # what no bore can be fitted to follows from a unit or poses that are in doubt
            doubts = [placed.facts.get(f"{of}_doubt") for of in ("unit", "clock", "pose")]
            if doubt := next(filter(None, doubts), None):
                raise error.about(f"{doubt}; no bore can be fitted to them ({error})") from error
            raise


@contextmanager
def _naming(source: Path) -> Iterator[None]:
    try:
        yield
    except FitError as error:
        raise error if str(source) in str(error) else error.about(f"{source}: {error}") from error


_ARBITRARY = "arbitrarily: a registered cloud tells no direction, and --reverse turns it"


def _describe_growth(config: ReconstructConfig, grows: str) -> dict[str, str]:
    """Return the way that stations grow, in words, for the manifest; `grows` is the way without `--reverse`."""
    return {"stations_grow": f"against this, by --reverse: {grows}" if config.extent.reverse else grows}


def _fit_cloud(placed: Placed, config: ReconstructConfig, progress: Stages) -> Reconstruction:
    """Cleans a registered cloud, and fits axis, wall, track and lining to what is left."""
    located = placed.located
    stage = progress.start("fitting the bore", 4)
    everything = crop_cloud(placed.cloud, config.extent.crop)
    cleaned = clean_cloud(everything, config.centreline)
    backwards = False
    if located is not None:
        ends = cleaned.axis.local(located.trajectory.positions[[0, -1]] - everything.origin).station
        backwards = bool(ends[1] < ends[0])  # stations grow the way the sensor went
    if backwards != config.extent.reverse:
        cleaned = turn_round(cleaned)
    cloud = cleaned.cloud
    stage.advance()
    sections, smooth = fit_unfolded(cloud, cleaned.axis, config.centreline.cutoff, cleaned.behind)
    stage.advance()
    seen = measure_gauge(find_track(cloud, smooth, sections.flat_floor), placed.low, smooth)
    stage.advance()
    bore, provenance = add_lining(smooth, sections, cloud, config.lining, railway=seen.shows_rails)
    stage.advance()
    facts = {
        "length_fixed_by": "registered cloud as given", **placed.facts,
        **_describe_growth(config, _ARBITRARY if located is None else "with the trajectory"), "returns": cloud.returns,
        "points": len(cloud.points), "flat_floor": sections.flat_floor, **bore.describe(),
    }  # fmt: skip
    removed = tuple(part.shifted(-sections.grid.start) for part in cleaned.removed)
    return Reconstruction(
        bore, cloud.origin, placed.record, facts, provenance,
        located.trajectory if located is not None and located.estimated else None,
        cloud, everything, removed, cleaned.cause, seen,
    )  # fmt: skip


def _fit_rings(path: Path, config: ReconstructConfig, progress: Stages) -> Reconstruction:
    survey = read_ring_survey(path, config.reading.unit, given_columns(path, config.reading.columns))
    if config.extent.reverse:
        survey = survey.reversed()
    print(f"detected: {describe({'kind': 'ring survey', **survey.facts})}", flush=True)
    bore, origin, provenance, facts = fit_ring_survey(survey, config.lining)
    facts |= _describe_growth(config, "with the order of the rings in the file")
    return Reconstruction(bore, origin, hash_inputs([path], progress), facts, provenance)


def judge(result: Reconstruction, track: Track, config: JudgingConfig) -> Judgement:
    """Judges a bore with its track against all returns, and its sizes against those of tunnels."""
    doubts = doubt_bore(result.bore, result.facts, result.provenance, result.everything is not None)
    doubts += doubt_track(track, result.seen, result.facts.get("pose_doubt"))
    doubts += [] if result.cloud is None else doubt_layers(result.bore, result.cloud)
    judgement = Judgement(config.tolerance, ())
    if result.everything is not None:
        zone = track_zone(track, result.bore)
        judgement = judge_bore(result.bore, result.everything, config, zone, result.cause, result.removed)
    doubt = result.facts.get("clock_doubt") or result.facts.get("pose_doubt")
    seen = blame_poses(judgement.warnings) if doubt else judgement.warnings
    found = sorted([*doubts, *seen], key=lambda warning: not warning.refuses)
    return replace(judgement, warnings=tuple(found))


def blame_poses(warnings: Iterable[Warned]) -> list[Warned]:
    """Return warnings that name nothing in the bore: where clocks or poses are at fault, they scatter the returns."""
    reason = "; the poses, or their clock, scatter them"
    return [
        replace(one, text=one.text.partition(", most ")[0] + reason) if one.code is Code.UNEXPLAINED else one
        for one in warnings
        if one.code is not Code.PLACE
    ]


def _require_trust(name: str, result: Reconstruction, judgement: Judgement, force: bool) -> None:
    """Raises `FitError` with the report on a bore that the judgement refuses, unless by `force`."""
    try:
        require_trust(judgement, force)
    except FitError as error:
        shown = {"detected": result.facts, "removed": [part.facts for part in result.removed]}
        error.page = render_page(name, result.bore, judgement, shown)
        raise


def _print_time(started: float, text: str) -> None:
    print(f"[{time.monotonic() - started:6.1f} s] {text}", flush=True)


def command(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="input", metavar="INPUT")],
    more: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[BAG ...]")] = (),
    /,
    *,
    out: Path,
    trajectory: Path | None = None,
    control: Path | None = None,
    calibration: str | None = None,
    reader: str | None = None,
    config: Annotated[BuildConfig, tyro.conf.arg(name="")] = _DEFAULT,
) -> Callable[[], Reconstruction]:
    """Builds a scene from a recording.

    Example: python -m scene.build survey.bag --trajectory groundtruth.tum --out build/tunnel

    Args:
        source: A bag (ROS1, ROS2, MCAP), a folder of bags or of timed scans, a cloud (PLY, PCD, LAS, E57,
            PTX, PTS, XYZ, CSV) or a ring survey (CSV, XLSX).
        more: Further bags of the same recording.
        out: Folder to write; replaced only once the new scene is complete.
        trajectory: Poses of the LiDAR in TUM or EuRoC form, for a bag; without it, LiDAR odometry.
        control: Positions of a prism in TUM form that fix odometry's length.
        calibration: Mounts of prism and IMU: geode-gamma, a YAML file, or the prism's x,y,z, m.
        reader: Python file or module of your own that registers a reader.
        config: Settings.
    """
    return partial(build, source, out, trajectory, config, control, calibration, reader, more)


def main() -> int:
    """Runs the command and returns its exit status."""
    needed = parse(lambda words: tyro.cli(command, prog="python -m scene.build", args=words))

    def act() -> None:
        try:
            needed()
        except FitError as error:
            raise error.about(f"{error} [{error.code}]") from error

    return run_command(act, "interrupted; the output is as it was, and the same command goes on")


if __name__ == "__main__":
    sys.exit(main())
