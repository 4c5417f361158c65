"""Commands on windows alone, which take seconds: judge a scene, set the limits of windows, put in faults at random."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fidelity.case import Case, case_hash
from benchmarks.fidelity.controls import chance, ladder
from benchmarks.fidelity.files import FidelityError, read_json, write_json
from benchmarks.fidelity.impostors import truth_candidate
from benchmarks.fidelity.inputs import Inputs, complete_inputs, read_case
from benchmarks.fidelity.windows.judge import dump_windows, judge_windows, windows_hash, worst_windows
from benchmarks.fidelity.windows.measures import LIMITS, MEASURES, SENSORS, STANDARD_SENSOR, Series
from subterra_jax.host.files import require_folder

SCHEMA = "subterra.fidelity-windows/1"
LIMITS_SCHEMA = "subterra.fidelity-limits/1"
PERCENTILE = 99.9  # of the windows of calibration surveys in which nothing is wrong
MARGIN = 1.5  # times that
FEWEST = 3  # surveys


@dataclass(frozen=True)
class FaultsConfig(Inputs):
    """Faults to draw.

    Attributes:
        count: Number of faults.
        draw: Seed that draws them.
        kinds: Kinds to draw from; all where empty.
        join: Folders of such runs on other scenes, for one table.
        near: Judge only the windows near a fault, up to one beyond its limit.
        ladder: Find the smallest size noticed of six kinds at random places.
        places: Number of places of each kind on a ladder.
    """

    count: int = 200
    draw: int = 0
    kinds: tuple[str, ...] = ()
    join: tuple[Path, ...] = ()
    near: bool = False
    ladder: bool = False
    places: int = 24


def run_windows(inputs: Inputs) -> None:
    """Judges a scene by its worst windows alone, in seconds.

    Example: python -m benchmarks.fidelity windows --scene build/tunnel --recording held.bag --trajectory poses.tum
    """
    require_folder(inputs.out)
    case = read_case(complete_inputs(inputs))
    if case.hold is None and case.truth is None:
        raise FidelityError("windows need a reference: give --recording with --trajectory, or --truth")
    found = judge_windows(case)
    candidates = {"base": case}
    if case.truth is not None:
        candidates["ceiling"] = replace(case, candidate=truth_candidate(case.truth, case.candidate), cache={})
    content = {
        "schema": SCHEMA, "key": f"{case_hash(case)} {windows_hash()}", **dump_windows(found),
        "series": {name: _series(one) for name, one in candidates.items()},
    }  # fmt: skip
    write_json(inputs.out / "windows.json", content, digits=17)
    reasons = found.reasons()
    print(f"windows of {case.candidate.name}: {'FAIL' if reasons else 'PASS'}")
    for reason in reasons:
        print(f"  {reason}")


def _series(case: Case) -> dict[str, dict[str, list[float | None]]]:
    kept: dict[str, Series] = {}
    worst_windows(case, kept)
    return {
        name: {"start": one.start.tolist(), "value": [v if np.isfinite(v) else None for v in one.value.tolist()]}
        for name, one in kept.items()
    }


def set_limits(runs: tuple[Path, ...], out: Path = LIMITS, sensor: str = STANDARD_SENSOR) -> None:
    """Sets the limits of windows from simulated surveys in which nothing is wrong.

    Args:
        runs: Output folders of `windows` on simulated surveys with `--truth`.
        out: File to write.
        sensor: LiDAR that recorded them; of another than the standard one only limits against a recording are set,
            beside what the file holds.

    Raises:
        FidelityError: Fewer than three surveys, a folder without their results, or an unknown sensor.
    """
    if sensor not in SENSORS:
        raise FidelityError(f"no sensor {sensor!r}; there are {', '.join(SENSORS)}")
    if len(runs) < FEWEST:
        raise FidelityError(f"limits need {FEWEST} simulated surveys, {len(runs)} were given")
    values: dict[str, list[float]] = {}
    for folder in runs:
        content = read_json(folder / "windows.json", SCHEMA)
        if "ceiling" not in content.get("series", {}):
            raise FidelityError(f"{folder}: was judged without --truth, so nothing says that nothing is wrong there")
        for series in content["series"].values():
            for name, one in series.items():
                values.setdefault(name, []).extend(v for v in one["value"] if v is not None)
    frozen = {}
    for one in MEASURES:
        for source in ("recording", "truth"):
            if known := values.get(f"{one.id}.{source}"):
                usual = float(np.percentile(known, PERCENTILE))
                limit = None if usual > one.gate else round(float(np.clip(MARGIN * usual, one.floor, one.gate)), 4)
                frozen[f"{one.id}.{source}"] = {
                    "limit": limit,
                    "p999": round(usual, 5),
                    "windows": len(known),
                }
    surveys = sorted(folder.name for folder in runs)
    kept: dict[str, Any] = read_json(out, LIMITS_SCHEMA) if out.exists() else {"schema": LIMITS_SCHEMA}
    if sensor == STANDARD_SENSOR:
        kept |= {"surveys": surveys, "limits": frozen}
    else:
        own = {name: one for name, one in frozen.items() if name.endswith(".recording")}
        kept["sensors"] = kept.get("sensors", {}) | {sensor: own}
    write_json(out, kept)
    print(f"{out}: {len(frozen)} limits from {len(surveys)} surveys")


def run_faults(config: FaultsConfig) -> None:
    """Puts in faults of random kind, place, length and size; goes on where it was cut short.

    Example: python -m benchmarks.fidelity faults --count 200 --scene build/tunnel --truth build/survey
    """
    if config.ladder:
        return _run_ladder(config)
    chance.check_draw(config.count, config.draw, config.kinds)
    earlier = [row for folder in config.join for row in chance.read_rows(folder)]
    require_folder(config.out)
    case = read_case(complete_inputs(config))
    if case.hold is None and case.truth is None:
        raise FidelityError("faults need a reference: give --recording with --trajectory, or --truth")
    rows = chance.run_faults(case, config.count, config.draw, config.kinds, config.out, config.near)
    summary = chance.write_curves(config.out, rows + earlier)
    noticed = sum(bool(row["by"]) for row in rows)
    print(f"{case.candidate.name}: {noticed} of {len(rows)} faults noticed; {config.out / 'curves.csv'} over "
          f"{len(rows) + len(earlier)}")  # fmt: skip
    for kind in summary:
        size = "not reached" if kind["size_95"] is None else f"{kind['size_95']:.3g} {kind['unit']}"
        print(f"  {kind['kind']}: {kind['noticed']} of {kind['count']}; 95 % from {size}")


def _run_ladder(config: FaultsConfig) -> None:
    require_folder(config.out)
    if config.draw < 0:
        raise FidelityError(f"draw must not be negative, got {config.draw}")
    case = read_case(complete_inputs(config))
    if case.hold is None and case.truth is None:
        raise FidelityError("faults need a reference: give --recording with --trajectory, or --truth")
    ladder.check_ladder(config.kinds, config.places, case.candidate.length)
    rows = ladder.climb_ladders(case, config.kinds, config.places, config.draw, config.out)
    print(
        f"{case.candidate.name}: smallest sizes noticed at 95 % of {config.places} places; {config.out / 'ladder.csv'}"
    )
    for one in ladder.write_ladder(config.out, rows):
        factor, unit = (1000.0, "mm") if one["kind"] == "gauge" else (100.0, "cm")
        print(f"  {one['kind']} over {one['length']:g} m: {factor * one['size_95']:.2g} {unit} "
              f"({factor * one['low']:.2g} to {factor * one['high']:.2g}); {factor * one['asked']:g} {unit} noticed at "
              f"{one['noticed_at_asked']} of {one['places']}")  # fmt: skip
