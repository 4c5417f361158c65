"""Tubes with one dimension wrong: what each metric says of it, by dimension; a copy is right within noise."""

import json
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.fidelity.case import Case
from tests.benchmarks.fidelity.judged import BARE, DEFAULT, PLAIN, SHORT, against, category, judged, measure
from tests.benchmarks.fidelity.tube import Tube

Bounds = tuple[float, float]


def about(value: float, by: float = 1e-9) -> Bounds:
    return value - by, value + by


def below(value: float) -> Bounds:
    return -1e99, np.nextafter(value, -inf)


def above(value: float) -> Bounds:
    return np.nextafter(value, inf), 1e99


def bounds(text: str) -> tuple[str, Bounds]:
    """A metric, and the least and the largest value that it may have."""
    metric, sign, *numbers = text.split()
    if sign in WITHOUT:
        return metric, (WITHOUT[sign], WITHOUT[sign])
    value, *other = map(float, numbers)
    return metric, {"<": below, ">": above, "≈": about, "in": lambda low, high: (low, high)}[sign](value, *other)


def value_of(metric: str, case: Case) -> float:
    value = measure(metric, case)
    return WITHOUT["failed" if value.failed else "missing"] if value.value is None else value.value


def row_of(line: str) -> tuple[Any, dict[str, Any], dict[str, Bounds]]:
    named, _, metrics = line.partition("}: ")
    right, _, changes = f"{named}}}".partition(" ")
    changes = {name: tuple(value) if isinstance(value, list) else value for name, value in json.loads(changes).items()}
    return TUBES[right], changes, dict(map(bounds, metrics.split("; ")))


FLAT = Tube(length=12.0, bend=inf, grade=0.0, variation=0.0, depth=0.0, track=False)
WITHOUT = {"failed": inf, "missing": -inf}
TUBES = {"SIX": Tube(length=6.0), "FLAT": FLAT, "LOW": replace(FLAT, width=2.4, height=1.3), "BARE": BARE,
         "PLAIN": PLAIN, "SHORT": SHORT, "DEFAULT": DEFAULT}  # fmt: skip
ROWS = Path(__file__).with_name("tubes.txt").read_text(encoding="utf-8").splitlines()
KNOWN = [row_of(line) for line in ROWS if not line.startswith("#")]


@pytest.mark.parametrize(
    ("right", "changes", "known"), KNOWN, ids=[f"{next(iter(ids))[:3]}-{changes}" for _, changes, ids in KNOWN]
)
def test_a_tube_of_other_dimensions_has_the_values_that_follow(right, changes, known) -> None:
    case = (judged if right == DEFAULT else partial(against, right))(**changes)
    values = {id: value_of(id, case) for id in known}
    assert {id: values[id] for id, (low, high) in known.items() if not low <= values[id] <= high} == {}


@pytest.mark.parametrize(("name", "least"), [("C2M", 98.0), ("CMP", 99.0), ("DIS", 98.0), ("OCC", 95.0)])
def test_the_right_tube_is_good_in_a_category(name, least) -> None:
    assert category(name, judged()) > least
