"""Commands on windows alone: judge a scene in seconds, find the smallest faults that they notice."""

from dataclasses import dataclass

from benchmarks.fidelity.case import case_hash
from benchmarks.fidelity.faults import ladder
from benchmarks.fidelity.files import FidelityError, write_json
from benchmarks.fidelity.inputs import Inputs, complete_inputs, read_case
from benchmarks.fidelity.windows.judge import dump_windows, judge_windows
from subterra_jax.host.files import require_folder

SCHEMA = "subterra.fidelity-windows/1"


@dataclass(frozen=True)
class FaultsConfig(Inputs):
    """Faults to draw.

    Attributes:
        draw: Seed that draws their places.
        kinds: Kinds to put in; all that a size is asked of where empty.
        places: Number of places of each kind.
    """

    draw: int = 0
    kinds: tuple[str, ...] = ()
    places: int = 6


def run_windows(inputs: Inputs) -> None:
    """Judges a scene by its worst windows alone, in seconds.

    Example: python -m benchmarks.fidelity windows --scene build/tunnel --recording held.bag --trajectory poses.tum
    """
    require_folder(inputs.out)
    case = read_case(complete_inputs(inputs))
    if not case.has("reference"):
        raise FidelityError("windows need a reference: give --recording with --trajectory, or --truth")
    found = judge_windows(case)
    content = {"schema": SCHEMA, "key": case_hash(case), **dump_windows(found)}
    write_json(inputs.out / "windows.json", content, digits=17)
    reasons = found.reasons()
    print(f"windows of {case.candidate.name}: {'FAIL' if reasons else 'PASS'}")
    for reason in reasons:
        print(f"  {reason}")


def run_faults(config: FaultsConfig) -> None:
    """Finds the smallest fault noticed, of each of six kinds at random places; goes on where it was cut short.

    Example: python -m benchmarks.fidelity faults --places 6 --scene build/tunnel --truth build/survey
    """
    require_folder(config.out)
    ladder.check_ladder(config.kinds, config.places, config.draw)
    case = read_case(complete_inputs(config))
    if not case.has("reference"):
        raise FidelityError("faults need a reference: give --recording with --trajectory, or --truth")
    rows = ladder.climb_ladders(case, config.kinds, config.places, config.draw, config.out)
    print(
        f"{case.candidate.name}: smallest sizes noticed at 95 % of {config.places} places; {config.out / 'ladder.csv'}"
    )
    for one in ladder.write_ladder(config.out, rows):
        factor, unit = (1000.0, "mm") if one["kind"] == "gauge" else (100.0, "cm")
        print(f"  {one['kind']} over {one['length']:g} m: {factor * one['size_95']:.2g} {unit} "
              f"({factor * one['low']:.2g} to {factor * one['high']:.2g}); {factor * one['asked']:g} {unit} noticed at "
              f"{one['noticed_at_asked']} of {one['places']}")  # fmt: skip
