"""A candidate with its references and seed; results kept once per case, recording or truth; hashes."""

import ctypes
import gc
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache as run_once
from functools import wraps
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import trimesh

from benchmarks.fidelity import table
from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.references import Hold, Truth

_KEPT_UNTIL: dict[tuple[str, str], str] = {}


@dataclass(frozen=True)
class Case:
    """Everything that a metric may read."""

    candidate: Candidate  # The reconstruction to judge
    hold: Hold | None = None  # Held-out recording; `None` where there is none
    # Beams of the recording that the builder read, for `c2m_fit_hold_gap`; `None` where it is not at hand
    fit: Hold | None = None
    truth: Truth | None = None  # Truth of the generator; `None` for real data
    seed: int = 0  # Seed of sampling, noise and bootstrap
    cache: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)  # Results of `derive` for this case

    def has(self, need: table.Need | None) -> bool:
        """Return True where the reference that something cannot do without is at hand."""
        present = {"hold": self.hold is not None, "truth": self.truth is not None}
        return need is None or (any(present.values()) if need == "reference" else present[need])

    def fresh(self) -> "Case":
        """Return a copy without any kept result, its references included."""
        bare: dict[str, Any] = {
            name: None if reference is None else replace(reference, cache={})
            for name, reference in (("hold", self.hold), ("fit", self.fit), ("truth", self.truth))
        }
        return replace(self, **bare, cache={})

    def forget(self, category: str) -> None:
        """Drops the results that no category after this one needs, and the caches of the meshes.

        A result that is asked for again later goes with the category that asked. Edges, adjacency and normals that
        `trimesh` keeps beside a mesh are several times the mesh.
        """
        order = list(table.CATEGORIES)
        done = order[: order.index(category) + 1] if category in order else []
        caches = [self.cache, *(reference.cache for reference in (self.hold, self.truth) if reference)]
        for results in caches:
            for key in [key for key in results if _KEPT_UNTIL.get(key[:2]) in done]:
                del results[key]
        meshes = [value for value in self.cache.values() if isinstance(value, trimesh.Trimesh)]
        meshes += [] if self.truth is None else [self.truth.surface]
        for mesh in (*meshes, self.candidate.lining, self.candidate.solid):
            mesh._cache.clear()

    def rng(self, id: str) -> np.random.Generator:
        """Return the random numbers of one metric; other metrics do not shift them."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(zlib.crc32(id.encode()),)))


Function = TypeVar("Function", bound=Callable[..., Any])


def kept_until(category: str, keep: Callable[[Function], Function]) -> Callable[[Function], Function]:
    """Keeps a large result, by `per_case` or another, until a category is done; asked for again it is computed again.

    A wrong category costs time and nothing else.
    """

    def mark(function: Function) -> Function:
        _KEPT_UNTIL[function.__module__, function.__qualname__] = category
        return keep(function)

    return mark


def _reference_cache(case: Case, reference: Hold | Truth | None) -> tuple[dict[Any, Any], tuple[Any, ...]]:
    assert reference is not None
    return reference.cache, (case.seed,)


def _keeper(place: Callable[..., tuple[dict[Any, Any], tuple[Any, ...]]]) -> Callable[[Function], Function]:
    """Keeps the results of a function in the dictionary that `place` gives, by its arguments and the given settings."""

    def keep(function: Function) -> Function:
        @wraps(function)
        def once(case: Case, *args: Any) -> Any:
            results, settings = place(case, *args)
            key = (function.__module__, function.__qualname__, *settings, *args)
            if key not in results:
                results[key] = function(case, *args)
            return results[key]

        return cast(Function, once)

    return keep


# Each keeps the results of a function of a case: once a case, or for all candidates those of recording and seed, of
# truth and seed, of the truth or else the recording, and where the second argument `real` is true.
per_case = _keeper(lambda case, *_: (case.cache, ()))
per_hold = _keeper(lambda case, *_: _reference_cache(case, case.hold))
per_truth = _keeper(lambda case, *_: _reference_cache(case, case.truth))
per_reference = _keeper(lambda case, *_: _reference_cache(case, case.truth or case.hold))
per_side = _keeper(lambda case, real: _reference_cache(case, case.hold) if real else (case.cache, ()))


@run_once
def code_hash() -> str:
    """Return the SHA-256 of the suite's code, tables and limits; results of another code are not read again."""
    here, digest = Path(__file__).parent, sha256()
    for file in sorted(path for path in here.rglob("*") if path.suffix in (".py", ".csv", ".json")):
        digest.update(file.relative_to(here).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def case_hash(case: Case) -> str:
    """Return the SHA-256 of candidate, references, seed and code."""
    digest = sha256(f"{code_hash()} {case.seed}".encode())
    digest.update(candidate_hash(case.candidate).encode())
    for hold in (case.hold, case.fit):
        digest.update(b"none" if hold is None else f"{hold.hash} {len(hold.range)}".encode())
    if case.truth is not None:
        digest.update(case.truth.surface.vertices.tobytes() + case.truth.position.tobytes())
    return digest.hexdigest()


def candidate_hash(candidate: Candidate) -> str:
    digest = sha256(json.dumps(candidate.manifest, sort_keys=True, default=str).encode())
    track = candidate.track
    for mesh in (candidate.lining, candidate.solid, candidate.extra, candidate.nails, candidate.bed,
                 track.sleeper_mesh, track.rail_mesh):  # fmt: skip
        digest.update(mesh.vertices.tobytes() + mesh.faces.tobytes())
    digest.update(candidate.bore.position.tobytes() + candidate.bore.radius.tobytes())
    for file in (candidate.scene, candidate.tunnel):
        digest.update(file.read_bytes() if file.exists() else b"none")
    return digest.hexdigest()


def release_memory() -> None:
    """Collects garbage and returns free memory to the system.

    Meshes and their rays refer to each other, so that only the collector frees them. glibc keeps the heap between two
    blocks in use: after the metrics of a bore of 36 m that is half of the process. Without glibc the second part is
    left out.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
