"""A candidate with the references that it is judged against, and the seeds and tolerances of this run."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, TypeVar

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.references import Hold, Truth

Result = TypeVar("Result")


@dataclass(frozen=True)
class Case:
    """Everything a metric may look at.

    Attributes:
        candidate: What is judged.
        hold: Held-out recording; `None` where there is none.
        fit: Beams of the recording that the builder read, for `c2m_fit_hold_gap`; `None` where it is not at hand.
        truth: Generator's truth; `None` for real data.
        seed: Of sampling, noise and bootstrap.
        tolerance: Factor on the tolerances inside metrics, for the sweep.
        cache: What `derive` has computed of this case.
    """

    candidate: Candidate
    hold: Hold | None = None
    fit: Hold | None = None
    truth: Truth | None = None
    seed: int = 0
    tolerance: float = 1.0
    cache: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    def fresh(self) -> "Case":
        """The same with nothing computed, of its references either."""
        bare: dict[str, Any] = {
            name: None if reference is None else replace(reference, cache={})
            for name, reference in (("hold", self.hold), ("fit", self.fit), ("truth", self.truth))
        }
        return replace(self, **bare, cache={})

    def let_go(self, category: str) -> None:
        """Forgets what is marked as of no use once a category is done, of the references too, and what meshes keep.

        Edges, adjacency and normals that `trimesh` keeps beside a mesh are several times the mesh.
        """
        caches = [self.cache, SHARED, *(reference.cache for reference in (self.hold, self.truth) if reference)]
        for cache in caches:
            for key in [key for key in cache if _UNTIL.get(key[:2]) == category]:
                del cache[key]
        meshes = [value for value in self.cache.values() if isinstance(value, trimesh.Trimesh)]
        for mesh in (*meshes, self.candidate.lining, self.candidate.solid):
            mesh._cache.clear()

    def rng(self, id: str) -> np.random.Generator:
        """Random numbers of one metric; other metrics do not shift them."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(zlib.crc32(id.encode()),)))


SHARED: dict[tuple[Any, ...], Any] = {}  # what was computed from released files, for all cases of this process
_UNTIL: dict[tuple[str, str], str] = {}


def until(category: str) -> Callable[[Callable[[Case], Result]], Callable[[Case], Result]]:
    """Marks a large result as the last of whose users a category is; asked for again, it is computed again.

    On top of `derived`, `of_hold` or `of_truth`. A mark that is wrong costs time and no more.
    """

    def mark(function: Callable[[Case], Result]) -> Callable[[Case], Result]:
        _UNTIL[function.__module__, function.__qualname__] = category
        return function

    return mark


def derived(function: Callable[[Case], Result]) -> Callable[[Case], Result]:
    """Computes a function of a case once a case."""

    @wraps(function)
    def once(case: Case) -> Result:
        key = (function.__module__, function.__qualname__)
        if key not in case.cache:
            case.cache[key] = function(case)
        return case.cache[key]

    return once


def of_hold(function: Callable[[Case], Result]) -> Callable[[Case], Result]:
    """Computes a function of the held-out recording, seed and tolerance alone once for all candidates."""

    @wraps(function)
    def once(case: Case) -> Result:
        assert case.hold is not None
        key = (function.__module__, function.__qualname__, case.seed, case.tolerance)
        if key not in case.hold.cache:
            case.hold.cache[key] = function(case)
        return case.hold.cache[key]

    return once


def of_truth(function: Callable[[Case], Result]) -> Callable[[Case], Result]:
    """Computes a function of the truth, seed and tolerance alone once for all candidates."""

    @wraps(function)
    def once(case: Case) -> Result:
        assert case.truth is not None
        key = (function.__module__, function.__qualname__, case.seed, case.tolerance)
        if key not in case.truth.cache:
            case.truth.cache[key] = function(case)
        return case.truth.cache[key]

    return once
