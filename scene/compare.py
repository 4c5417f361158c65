"""`python -m scene.compare A B`: change of a tunnel between two surveys, with the level of detection at each place.

Example: python -m scene.compare build/2024 build/2026 --out build/change

Both clouds are held against the axis of A, along the wall's own normals. A change counts where it is larger than its
level of detection, over patches of a least size that as a whole moved by three of their levels of detection.

Source: M3C2 and its level of detection, Lague, Brodu and Leroux 2013, ISPRS J. Photogramm. 82, 10-26; by py4dgeo.
"""

import csv
import json
import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
import tyro
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_erosion, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import t as student

from scene.bore import Bore, load_bore
from scene.errors import FitError, RecordingError, require_input
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_folder, require_folder

_AROUND = 90  # places around the section: 4 degrees
_FEWEST = 5  # points of either survey at a place
_SURE = 3.0  # levels of detection by which a patch as a whole must have moved: 6 standard deviations
_MEETS = 3.0  # m; surveys whose axes are further apart are of two tunnels, or in two frames


@dataclass(frozen=True)
class CompareConfig:
    """Change of a tunnel between two surveys.

    Attributes:
        before: Scene folder of the earlier survey, whose axis counts.
        after: Scene folder of the later survey, in the same frame.
        out: Folder to write.
        step: Distance between two places along the axis, m.
        radius: Radius of the patch over which a place's points are averaged, m.
        registration: Error of one frame against the other, one standard deviation, m; adds to the level of detection.
        least_area: Changes on less of the wall than this are left out, m².
    """

    before: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BEFORE")]
    after: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="AFTER")]
    out: Path
    step: float = 0.25
    radius: float = 0.25
    registration: float = 0.002
    least_area: float = 0.5


@dataclass(frozen=True)
class Change:
    """A patch of wall that has moved.

    Attributes:
        start: Station at which it begins, m.
        end: Station at which it ends, m.
        angle: Direction of its middle from the axis, rad, from the left upwards.
        area: Its area, m².
        median: Median movement, outwards positive, m; of the places further from the patch's rim than their points are
            averaged over, where it has any, since those at the rim average over moved and unmoved wall.
        most: Largest movement by size, m.
        detection: Median level of detection there, 95 %, m.
    """

    start: float
    end: float
    angle: float
    area: float
    median: float
    most: float
    detection: float


@dataclass(frozen=True)
class Comparison:
    """Movement of the wall at places on a grid over station and angle.

    Attributes:
        station: Stations, m.
        angle: Directions, rad, from the left upwards.
        moved: Movement outwards, m; NaN where either survey has too few points.
        detection: Level of detection, 95 %, m.
        changes: Patches that have moved, the largest first.
    """

    station: Float[np.ndarray, " s"]
    angle: Float[np.ndarray, " a"]
    moved: Float[np.ndarray, "s a"]
    detection: Float[np.ndarray, "s a"]
    changes: tuple[Change, ...]


def compare_clouds(
    bore: Bore, before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "k 3"], config: CompareConfig
) -> Comparison:
    """Compare two clouds in the tunnel frame of `bore`.

    Raises:
        FitError: No place of the wall holds points of both surveys.
    """
    station = np.arange(0.5 * config.step, bore.length, config.step)
    angle = -np.pi + 2.0 * np.pi * (np.arange(_AROUND) + 0.5) / _AROUND
    place, normal = _places(bore, station, angle)
    moved, detection = _move(place, normal, before, after, config)
    grid = (len(station), _AROUND)
    moved, detection = moved.reshape(grid), detection.reshape(grid)
    if not np.isfinite(moved).any():
        raise FitError("no place of the wall holds points of both surveys; are they of one tunnel and in one frame?")
    real = np.abs(moved) > detection  # False where either is NaN
    cell = config.step * np.linalg.norm(np.roll(place.reshape(*grid, 3), -1, axis=1) - place.reshape(*grid, 3), axis=2)
    changes = _patches(real, station, angle, moved, detection, cell, config)
    return Comparison(station, angle, moved, detection, changes)


def _places(bore: Bore, station: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the wall of a bore and its outward normals, station by station."""
    frame = bore.axis.at(station)
    columns = np.argsort(np.mod(bore.angle, 2.0 * np.pi))
    rows = np.rint(np.interp(station, bore.station, np.arange(len(bore.station)))).astype(int)
    radius = np.stack([
        np.interp(np.mod(angle, 2.0 * np.pi), np.mod(bore.angle, 2.0 * np.pi)[columns], bore.radius[row][columns],
                  period=2.0 * np.pi)
        for row in rows
    ])  # fmt: skip
    outwards = np.cos(angle)[None, :, None] * frame.lateral[:, None] + np.sin(angle)[None, :, None] * frame.up[:, None]
    place = frame.position[:, None] + radius[..., None] * outwards
    around = np.roll(place, -1, axis=1) - np.roll(place, 1, axis=1)
    normal = np.cross(around, np.broadcast_to(frame.tangent[:, None], around.shape))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    normal *= np.sign(np.sum(normal * outwards, axis=2, keepdims=True))
    return place.reshape(-1, 3), normal.reshape(-1, 3)


def _move(
    place: np.ndarray, normal: np.ndarray, before: np.ndarray, after: np.ndarray, config: CompareConfig
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    import py4dgeo

    logging.getLogger("py4dgeo").setLevel(logging.WARNING)  # below that it writes a log into the working directory
    # It counts with single precision in places.
    offset = place.mean(axis=0)
    m3c2 = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(before - offset), py4dgeo.Epoch(after - offset)), corepoints=place - offset,
        corepoint_normals=normal, cyl_radius=config.radius, max_distance=0.5, registration_error=config.registration,
    )  # fmt: skip
    moved, uncertainty = m3c2.run()
    count = np.stack([uncertainty["num_samples1"], uncertainty["num_samples2"]]).astype(float)
    enough = count.min(axis=0) >= _FEWEST
    share = np.stack([uncertainty["spread1"], uncertainty["spread2"]])[:, enough] ** 2 / count[:, enough]
    # Spreads of a few points are themselves uncertain: Student's t with Welch's degrees of freedom in place of 1.96.
    total = np.maximum(share.sum(axis=0), 1e-18)
    freedom = total**2 / np.maximum((share**2 / (count[:, enough] - 1.0)).sum(axis=0), 1e-36)
    detection = np.full(len(moved), np.nan)
    detection[enough] = student.ppf(0.975, np.maximum(freedom, 1.0)) * np.sqrt(total) + 1.96 * config.registration
    return np.where(enough, moved, np.nan), detection


def _patches(
    real: Bool[np.ndarray, "s a"], station: np.ndarray, angle: np.ndarray, moved: np.ndarray, detection: np.ndarray,
    cell: np.ndarray, config: CompareConfig,
) -> tuple[Change, ...]:  # fmt: skip
    """Return the connected places that moved one way, largest first; the wall closes on itself."""
    found = []
    for way in (1.0, -1.0):
        names, count = _label_closed(real & (way * moved > 0.0))
        for name in range(count):
            s, a = np.nonzero(names == name)
            area = float(cell[s, a].sum())
            # A patch averages over so many places that share no points, and a chance one is among thousands.
            apart = max(1.0, area / (np.pi * config.radius**2))
            sure = np.median(np.abs(moved[s, a]) / detection[s, a]) * np.sqrt(apart)
            if area < config.least_area or sure < _SURE:
                continue
            inner = _inside(names == name, max(1, int(np.ceil(config.radius / config.step))))
            values = moved[s, a]
            turn = np.angle(np.mean(np.exp(1j * angle[a])))
            half = 0.5 * config.step
            most = float(values[np.argmax(np.abs(values))])
            found.append(Change(
                float(station[s].min() - half), float(station[s].max() + half), float(turn), area,
                float(np.median(moved[inner] if inner.any() else values)), most, float(np.median(detection[s, a])),
            ))  # fmt: skip
    return tuple(sorted(found, key=lambda change: -change.area))


def _inside(mask: Bool[np.ndarray, "s a"], rim: int) -> Bool[np.ndarray, "s a"]:
    """Return the places of a patch with a rim of so many places taken off; the wall closes on itself."""
    closed = np.pad(mask, ((0, 0), (rim, rim)), mode="wrap")
    return binary_erosion(closed, np.ones((3, 3)), iterations=rim)[:, rim:-rim]


def _label_closed(mask: Bool[np.ndarray, "s a"]) -> tuple[Int[np.ndarray, "s a"], int]:
    """Number connected patches from 0, -1 elsewhere, with the last column beside the first; return also their count."""
    names, count = label(mask, np.ones((3, 3)))
    first, last = names[:, 0], np.pad(names[:, -1], 1)
    beside = [(first, last[k : k + len(first)]) for k in range(3)]
    left, right = (np.concatenate(side) for side in zip(*beside, strict=True))
    met = (left > 0) & (right > 0)
    links = coo_array((np.ones(met.sum()), (left[met], right[met])), shape=(count + 1, count + 1))
    _, group = connected_components(links, directed=False)
    kept = np.unique(group[1:])
    return np.where(names > 0, np.searchsorted(kept, group[names]), -1), len(kept)


def compare(config: CompareConfig) -> Comparison:
    """Compare two scene folders and write `changes.csv`, `change.npz` and `change.png`, whole or not at all.

    Raises:
        SubterraError: A folder is no scene or has no cloud, the two do not meet, or the output cannot be written.
    """
    require_folder(config.out)
    if not 0.05 <= config.step <= 5.0 or not 0.05 <= config.radius <= 5.0 or config.registration < 0.0:
        raise FitError("step and radius must lie between 0.05 and 5 m, and the registration error must not be negative")
    scenes = [_read_scene(folder) for folder in (config.before, config.after)]
    (bore, before, origin), (other, after, other_origin) = scenes
    shift = other_origin - origin
    away = np.median(np.linalg.norm(np.stack(bore.axis.local(other.position + shift)[1:]), axis=0))
    if away > _MEETS:
        raise FitError(
            f"{config.after}: its axis is {away:.0f} m from that of {config.before} in the median; are both of one "
            "tunnel, and in one frame?"
        )
    result = compare_clouds(bore, before, after + shift, config)
    with replace_folder(config.out) as folder:
        _write(folder, bore, result, config)
    return result


def _read_scene(folder: Path) -> tuple[Bore, np.ndarray, np.ndarray]:
    manifest = folder / "manifest.json"
    if not manifest.is_file():
        raise RecordingError(f"{folder}: not a scene folder, for it has no manifest.json; build it with scene.build")
    if not (folder / "cloud.ply").is_file():
        raise RecordingError(f"{folder}: has no cloud.ply, as scenes of ring surveys; two clouds are needed")
    cloud: Any = trimesh.load(require_input(folder / "cloud.ply"))
    points = np.asarray(cloud.vertices, float)
    origin = np.asarray(json.loads(manifest.read_text())["frame"]["origin"], float)
    return load_bore(folder / "bore.npz"), points, origin


def _write(folder: Path, bore: Bore, result: Comparison, config: CompareConfig) -> None:
    with (folder / "changes.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("from [m]", "to [m]", "clock", "area [m2]", "median [m]", "most [m]", "detection 95 % [m]"))
        for change in result.changes:
            sizes = (change.area, change.median, change.most, change.detection)
            writer.writerow((f"{change.start:.2f}", f"{change.end:.2f}", name_clock(change.angle),
                             *(f"{value:.4f}" for value in sizes)))  # fmt: skip
    np.savez_compressed(folder / "change.npz", station=result.station, angle=result.angle, moved=result.moved,
                        detection=result.detection)  # fmt: skip
    _draw(folder / "change.png", bore, result, config)


def name_clock(angle: float) -> str:
    """Return the direction from the axis as on a clock's face, looking ahead: 12 is the crown, 9 the left."""
    hour = (12.0 + (angle - np.pi / 2.0) / (2.0 * np.pi) * 12.0) % 12.0
    minutes = round(hour * 60.0 / 15.0) * 15 % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}"


def _draw(path: Path, bore: Bore, result: Comparison, config: CompareConfig) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(11, 6), sharex=True, layout="constrained")
    seen = np.abs(result.moved[np.isfinite(result.moved)])
    limit = max(0.01, float(np.quantile(seen, 0.995)))
    floor = _AROUND // 4  # the first column after the floor, at -pi / 2
    for one, field, title, colours, low in (
        (axes[0], result.moved, "moved outwards, m", "RdBu_r", -limit),
        (axes[1], result.detection, "level of detection, m", "viridis", 0.0),
    ):
        extent = (0.0, bore.length, 0.0, 4.0)
        image = one.imshow(np.roll(field, -floor, axis=1).T, origin="lower", aspect="auto", extent=extent, cmap=colours,
                           vmin=low, vmax=limit, interpolation="nearest")  # fmt: skip
        one.set_facecolor("0.85")
        one.set_yticks(range(5), ["floor", "left", "crown", "right", "floor"])
        figure.colorbar(image, ax=one, label=title)
    axes[1].set_xlabel("station of the earlier survey, m")
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)


def main(words: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    config = parse(
        lambda given: tyro.cli(CompareConfig, prog="python -m scene.compare", args=given, description=__doc__), words
    )

    def act() -> None:
        result = compare(config)
        for change in result.changes:
            place = f"{change.start:.1f} to {change.end:.1f} m at {name_clock(change.angle)}"
            print(f"{place}: {1e3 * change.median:+.1f} mm on {change.area:.1f} m²")
        if not result.changes:
            least = 1e3 * np.nanmedian(result.detection)
            print(f"nothing moved by more than its level of detection, {least:.1f} mm in the median")
        print(config.out / "change.png")

    return run_command(act, "interrupted; the output is as it was")


if __name__ == "__main__":
    sys.exit(main())
