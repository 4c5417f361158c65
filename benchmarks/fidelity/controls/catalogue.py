"""The table of controls: `controls.csv` beside the functions that carry each out."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls import assets, damage, objects, references, scenes, shape
from benchmarks.fidelity.null import null_tube

TABLE = Path(__file__).with_name("controls.csv")
OUT_OF_SCENE = "all but SCN PAR"


@dataclass(frozen=True)
class Setting:
    """What a control may use beside the case.

    Attributes:
        rng: Its own random numbers; the same for all doses.
        scratch: A folder to write a changed scene into.
        foreign: Makes another tunnel of the same class; only N33 asks for it.
    """

    rng: np.random.Generator
    scratch: Path
    foreign: Callable[[], Candidate]


@dataclass(frozen=True)
class Control:
    """A row of the table.

    Attributes:
        id: N01 to N36.
        corruption: In words.
        doses: In growing severity.
        bold: The doses that must FAIL.
        falls: Points that a category must lose at least at the bold dose.
        quiet: Categories that may move by at most 2 points.
        evaluated: Categories computed; the others are taken over from the base, since nothing they read has changed.
        reason: Why a row differs from the specification's, empty where it does not.
    """

    id: str
    corruption: str
    doses: tuple[float, ...]
    bold: tuple[float, ...]
    falls: dict[str, float]
    quiet: tuple[str, ...]
    evaluated: str
    reason: str


Spoil = Callable[[Case, float, Setting], Case]


@cache
def load() -> dict[str, Control]:
    """The controls by id, in order."""
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["id"]: Control(
            row["id"], row["corruption"], _numbers(row["doses"]), _numbers(row["bold"]),
            {pair.split()[0]: float(pair.split()[1]) for pair in row["falls"].split(";") if pair.strip()},
            tuple(row["quiet"].split()), row["evaluated"], row["reason"],
        )
        for row in rows
    }  # fmt: skip


def spoiled(case: Case, control: str, dose: float, setting: Setting) -> Case:
    """The case with one control at one dose.

    Raises:
        KeyError: No such control.
    """
    return SPOIL[control](case, dose, setting)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def _of(change: Callable[[Candidate, float, Setting], Candidate]) -> Spoil:
    return lambda case, dose, setting: replace(case, candidate=change(case.candidate, dose, setting), cache={})


def _scaled(candidate: Candidate, dose: float, setting: Setting) -> Candidate:
    factor = 1.0 + dose / 100.0
    made = scenes.scaled_scene(candidate, factor, setting.scratch)
    moved = shape.scaled(candidate, factor)
    return replace(moved, folder=made.folder, scene=made.scene, tunnel=made.tunnel)


def _dropped(candidate: Candidate, dose: float, setting: Setting) -> Candidate:
    made = scenes.holed_scene(candidate, dose / 100.0, setting.rng, setting.scratch)
    return damage.faces_dropped(made, dose / 100.0, setting.rng)


def _references(case: Case, dose: float, setting: Setting) -> Case:
    return (
        references.extrinsic_wrong(case, np.radians(2.0)) if dose < 2 else references.poses_permuted(case, setting.rng)
    )


def _forged(case: Case, dose: float, setting: Setting) -> Case:
    assert case.hold is not None
    return references.sampled_from_mesh(case, case.hold.sigma if dose >= 2 else 0.0, setting.rng)


def _pockets(candidate: Candidate, dose: float, setting: Setting) -> Candidate:
    if dose >= 3.0:
        return assets.pattern_shifted(candidate, 0.5 * assets.ring_pitch(candidate))
    return assets.pockets_scaled(candidate, dose, 1.0, setting.rng)


SPOIL: dict[str, Spoil] = {
    "N01": _of(_scaled),
    "N02": _of(lambda c, d, s: shape.section_scaled(c, 1 + d / 100, 1 + d / 100)),
    "N03": _of(lambda c, d, s: shape.section_scaled(c, 1 + d / 100, 1.0)),
    "N04": lambda case, d, s: shape.axial_stretch(case, 1 + d / 100),
    "N05": _of(lambda c, d, s: shape.yawed(c, np.radians(d))),
    "N06": _of(lambda c, d, s: shape.rolled(c, np.radians(d))),
    "N07": _of(lambda c, d, s: shape.shifted(c, d)),
    "N08": _of(lambda c, d, s: shape.floor_raised(c, d)),
    "N09": _of(lambda c, d, s: shape.shortened(c, d / 100)),
    "N10": _of(lambda c, d, s: shape.straightened(c, d / 100)),
    "N11": _of(lambda c, d, s: shape.waved(c, d)),
    "N12": _of(_dropped),
    "N13": _of(lambda c, d, s: damage.holed(c, d, s.rng)),
    "N14": _of(lambda c, d, s: damage.flipped(c, 1.0, s.rng)),
    "N15": _of(lambda c, d, s: damage.flipped(c, d / 100, s.rng)),
    "N16": _of(lambda c, d, s: damage.doubled(c, d / 100, s.rng)),
    "N17": _of(lambda c, d, s: damage.finned(c, int(d), s.rng)),
    "N18": _of(lambda c, d, s: damage.noisy(c, d, s.rng)),
    "N19": _of(lambda c, d, s: damage.coarsened(c, d / 100)),
    "N20": _of(lambda c, d, s: objects.blocked(c, whole=d >= 2)),
    "N21": _of(lambda c, d, s: objects.littered(c, int(d), s.rng)),
    "N22": _of(lambda c, d, s: assets.sleepers_removed(c, d / 100, s.rng)),
    "N23": _of(lambda c, d, s: assets.sleepers_respaced(c, d)),
    "N24": _of(lambda c, d, s: assets.gauge_changed(c, d)),
    "N25": _of(lambda c, d, s: assets.pockets_scaled(c, 0.0, d / 100, s.rng)),
    "N26": _of(_pockets),
    "N27": _of(lambda c, d, s: objects.pillared(c, d)),
    "N28": _of(lambda c, d, s: objects.mouth_closed(c)),
    "N29": _of(lambda c, d, s: scenes.one_collidable_mesh(c, s.scratch)),
    "N30": _of(lambda c, d, s: scenes.panels_off(c, d, s.scratch)),
    "N31": _of(lambda c, d, s: scenes.other_plan(c, d, s.scratch)),
    "N32": _references,
    "N33": lambda case, d, s: references.foreign(case, s.foreign()),
    "N34": _of(lambda c, d, s: null_tube(c, sleepers=d < 2)),
    "N35": _forged,
    "N36": lambda case, d, s: references.builder_read_hold(case),
}
