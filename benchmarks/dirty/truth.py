"""Cases: an input of the builder, and the truth that it is judged by."""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.command import BenchmarkError
from benchmarks.dirty.sizes import BAND, DESCRIBED, measure_sizes

GAUGE = 1.435  # m, of the tracks in the dirty clouds
_ENDING = "_truth.npz"
_INPUTS = (".laz", ".las", ".ply", ".pcd", ".e57", ".xyz", ".csv", ".npz", ".bag", "")


@dataclass(frozen=True)
class Truth:
    """Truth of one case.

    `NAME_truth.npz` holds at least `axis`, `wall` and `span`; other fields stand in it where they are known.
    """

    axis: Float[np.ndarray, "n 3"]  # Points of the true axis by growing station, m
    wall: Float[np.ndarray, "w 3"]  # Points of the lining that the scanner saw, m
    span: tuple[float, float]  # Stations that are judged, m
    axis_above_floor: Float[np.ndarray, " n"]  # m; NaN where it is not known
    width: Float[np.ndarray, " n"]  # Largest inner width, m; NaN where it is not defined
    height: Float[np.ndarray, " n"]  # Floor to crown on the axis, m; NaN where it is not defined
    track: str = ""  # `none`, `single` or `double`; empty where it is not known
    proud: float = 0.0  # Top of the sleepers above the floor, m
    gauge: float = float("nan")  # m
    sleepers: Float[np.ndarray, "k 3"] = field(default_factory=lambda: np.empty((0, 3)))  # Middles of their tops, m
    ends: tuple[float, float] = (float("nan"), float("nan"))  # Stations at which the lining ends, m
    bulge: tuple[str, ...] = ()  # Sizes judged by their median alone
    band: tuple[float, float] = (float("nan"), float("nan"))  # Heights about the axis that `width` is the median of, m
    plain: bool = False  # True where the lining has neither rings nor pockets, and none may be called measured
    expect: str = "built"  # `built`, or `refused` where there is no tunnel
    trouble: tuple[float, float] = (float("nan"), float("nan"))  # Stations of the trouble, m
    must_say: bool = False  # True where even a right scene must come with a warning that names the cause
    cause: tuple[str, ...] = ()  # Words of which a warning or refusal names at least one
    middle: Float[np.ndarray, " n"] | float = 0.0  # Of both walls, to the left of the axis, m: rough walls move it

    @property
    def station(self) -> Float[np.ndarray, " n"]:
        """Station of each point of the axis, m."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.axis, axis=0), axis=1))])


@dataclass(frozen=True)
class Case:
    """One input with its truth."""

    name: str  # Name of the case
    source: Path  # Input of the builder
    truth: Path  # Truth file
    arguments: tuple[str, ...] = ()  # Further words for the builder; `{folder}` stands for the folder of the case
    kind: str = ""  # Kind of cloud or trouble, by which tables are summed up

    @property
    def words(self) -> list[str]:
        """Words of the builder's command line, without `--out`."""
        return [str(self.source), *(word.replace("{folder}", str(self.truth.parent)) for word in self.arguments)]


def find_cases(folder: Path, only: tuple[str, ...] = ()) -> list[Case]:
    """Return the cases of a folder by name.

    Args:
        folder: Folder with `NAME.laz`, or another input called `NAME`, beside each `NAME_truth.npz`.
        only: Beginnings of the names wanted; all where it is empty.

    Raises:
        BenchmarkError: The folder holds no case of such a name, or a truth has no input beside it.
    """
    cases = []
    for truth in sorted(folder.glob(f"*{_ENDING}")):
        name = truth.name.removesuffix(_ENDING)
        if only and not name.startswith(only):
            continue
        with _opened(truth) as data:
            arguments = tuple(str(word) for word in data.get("arguments", ()))
            kind = str(data.get("kind", name.rsplit("-", 1)[0]))
            told = [folder / str(data["source"])] if "source" in data else []
        beside = [folder / f"{name}{ending}" for ending in _INPUTS]
        inputs = [path for path in told or beside if path.exists()]
        if not inputs:
            raise BenchmarkError(f"{truth}: there is no cloud {name} beside it")
        cases.append(Case(name, inputs[0], truth, arguments, kind))
    if not cases:
        raise BenchmarkError(f"{folder}: no NAME{_ENDING}" + (f" that begins with {' or '.join(only)}" if only else ""))
    return cases


def _pair(value: Any) -> tuple[float, float]:
    return float(value[0]), float(value[1])


def _words(value: Any) -> tuple[str, ...]:
    return tuple(map(str, value))


_READ: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(("span", "ends", "trouble", "band"), _pair),
    **dict.fromkeys(("track", "expect"), str),
    **dict.fromkeys(("proud", "gauge"), float),
    **dict.fromkeys(("bulge", "cause"), _words),
    **dict.fromkeys(("plain", "must_say"), bool),
    **dict.fromkeys(("axis", "wall", "sleepers"), np.asarray),
}
_ALONG = ("axis_above_floor", "width", "height", "middle")  # at each point of the axis, or one for all


def load_truth(case: Case) -> Truth:
    """Reads the truth of a case; sizes that it does not hold are measured where its kind is described.

    Raises:
        BenchmarkError: The file is no truth.
    """
    with _opened(case.truth) as data:
        if missing := {"axis", "wall", "span"} - set(data):
            raise BenchmarkError(f"{case.truth}: has no {' and no '.join(sorted(missing))}")
        values: dict[str, Any] = {name: data[name] for name in data}
    known = DESCRIBED.get(case.kind) if "width" not in values and case.source.suffix == ".laz" else None
    if known is not None:
        facts: dict[str, Any] = {"track": known.track, "proud": known.proud, "bulge": known.bulge, "band": BAND}
        values = facts | {"gauge": GAUGE if known.track != "none" else np.nan} | values
        values |= measure_sizes(case.source, values["axis"], values["wall"], known)
    values = {**dict.fromkeys(_ALONG[:3], np.nan), **values}
    given = {name: read(values[name]) for name, read in _READ.items() if name in values}
    count = len(given["axis"])
    given |= {name: np.broadcast_to(np.asarray(values[name], float), count) for name in _ALONG if name in values}
    return Truth(**given)


def _opened(path: Path) -> "np.lib.npyio.NpzFile":
    try:
        return np.load(path)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise BenchmarkError(f"{path}: not a truth file ({error})") from error
