"""`python -m scene.report DIR`: takeaways for surveyors from a built scene.

Example: python -m scene.report build/tunnel --design axis.xml --out build/tunnel-report
"""

import csv
import dataclasses
import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import ezdxf
import numpy as np
import trimesh
import tyro

from scene.bore import Bore, load_bore
from scene.errors import FitError, RecordingError, require_input
from scene.report import drawings, sections
from scene.report.alignment import AlignmentFit, Design, align_bore, design_of, read_design_table, turn_around
from scene.report.clearance import CONTOURS, Rails, bend, clearance, contour, read_gauge, read_rails
from scene.report.ifc import write_ifc
from scene.report.landxml import read_landxml, write_landxml
from scene.report.page import write_report
from scene.report.tables import write_csv, write_points, write_workbook
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_folder, require_folder

_MEETS = 5.0  # m; a design axis further from the bore than this is another tunnel's
_SHORT = 20.0  # m; elements are longer where an axis was built to elements, and not just as rough as its walls
_WANDERS = (
    f"; half of the elements are shorter than {_SHORT:.0f} m: the axis wanders, and --tolerance 0.02 asks for fewer"
)


@dataclass(frozen=True)
class ReportConfig:
    """Takeaways for surveyors from a built scene.

    Attributes:
        scene: Scene folder, as `scene.build` writes it.
        out: Folder to write; beside the scene, with `-report`, if not given.
        design: Design axis: LandXML, or CSV with CHAINAGE, EASTING, NORTHING, ELEVATION; gives the chainages.
        section: Design section: CSV of rows `left, up` about the axis, m; else `--radius`, else the bore's own median.
        radius: Design radius of a round bore, m.
        gauge: Loading gauge: `ga`, `gb`, `gc`, or CSV of a closed polygon of rows `left, height over rail`, m.
        start: Chainage of station 0, m; that of the manifest if neither this nor a design is given.
        tolerance: Root mean square that an alignment of fewer elements may add to what many elements leave, m; if not
            given, elements are kept as long as the noise of the axis does not explain them.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    out: Path | None = None
    design: Path | None = None
    section: Path | None = None
    radius: float | None = None
    gauge: Literal["ga", "gb", "gc"] | Path = "ga"
    start: float | None = None
    tolerance: float | None = None


def report(config: ReportConfig) -> Path:
    """Write the folder whole, or not at all; returns it.

    Raises:
        SubterraError: The scene, design, section or gauge is at fault, or the output cannot be written.
    """
    out = require_folder(config.out or config.scene.with_name(f"{config.scene.name}-report"))
    manifest = _read_manifest(config.scene)
    bore = load_bore(require_input(config.scene / "bore.npz"))
    origin = np.asarray(manifest["frame"]["origin"], float)
    design = None if config.design is None else _read_design(config.design, origin)
    located = None if design is None else _locate(bore, design, config.design)
    chainage = _chainages(config, manifest, bore, design)
    section = _read_section(bore, config)
    gauge = contour(str(config.gauge)) if config.gauge in CONTOURS else read_gauge(Path(config.gauge))
    fit = align_bore(bore, str(manifest["name"]), origin, float(chainage[0]), config.tolerance)
    if chainage[-1] < chainage[0]:
        fit = dataclasses.replace(fit, alignment=turn_around(fit.alignment, float(chainage[-1])))
    with replace_folder(out) as folder:
        facts = _facts(bore, manifest, section.name, chainage, fit)
        wanted = {"metres": sections.at_round_chainages(bore, chainage, 1.0), "rings": bore.ring_station}
        tables = {
            name: sections.tabulate(bore, section, origin, chainage, rows) for name, rows in wanted.items() if len(rows)
        }
        over, under = sections.volumes(bore, section)
        facts |= {"overbreak": f"{over:.2f} m³", "underbreak": f"{under:.2f} m³"}
        ezdxf.options.write_fixed_meta_data_for_testing = True  # no times of day
        drawings.write_sections(folder / "sections.dxf", bore, section, chainage)
        drawings.write_plan_profile(folder / "plan_profile.dxf", bore, origin, chainage)
        drawings.write_unrolled(folder, bore, section, chainage)
        drawings.draw_alignment(folder / "alignment.png", bore, fit, chainage)
        write_landxml(folder / "alignment.xml", fit.alignment)
        rails = read_rails(config.scene / "scene.xml", bore)
        write_ifc(folder / "tunnel.ifc", bore, fit.alignment, rails, config.scene / "scene.xml", origin)
        if design is not None and located is not None:
            facts |= _write_offsets(folder, bore, design, located)
        facts |= _write_clearance(folder, rails, bore, gauge, chainage)
        if (config.scene / "cloud.ply").is_file():  # a ring survey has none
            cloud: Any = trimesh.load(config.scene / "cloud.ply")
            points = np.asarray(cloud.vertices, float)
            write_points(folder / "points.laz", bore, points, origin, chainage)
        write_csv(folder / "sections.csv", tables["metres"])
        write_workbook(folder / "rings.xlsx", tables, facts)
        # Of a ring survey the rows between rings are interpolated: they show no place that is worse.
        judged = tables["rings" if bore.filled.mean() > 0.5 and "rings" in tables else "metres"]
        write_report(folder, str(manifest["name"]), facts, judged, _element_rows(fit, chainage))
    return out


def _read_manifest(scene: Path) -> dict[str, Any]:
    path = scene / "manifest.json"
    if not path.is_file():
        raise RecordingError(f"{scene}: not a scene folder, for it has no manifest.json; build it with scene.build")
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise RecordingError(f"{path}: not JSON ({error})") from error


def _read_design(path: Path, origin: np.ndarray) -> Design:
    if path.suffix.lower() == ".csv":
        return read_design_table(path, origin)
    return design_of(read_landxml(path), origin)


def _locate(bore: Bore, design: Design, path: Path | None) -> np.ndarray:
    """Return chainage, offset to the right and height above the design of the bore's axis."""
    grows = np.ptp(design.chainage) / design.axis.length
    if not 0.5 < grows < 2.0:
        raise FitError(
            f"{path}: the chainage grows by {grows:.3g} m on a metre of the design axis; has it another unit than its "
            "coordinates?"
        )
    located = design.locate(bore.position)
    away = np.hypot(located[:, 1], located[:, 2] if design.has_heights else 0.0)
    if np.median(away) > _MEETS:
        raise FitError(
            f"{path}: the design axis does not meet the tunnel: it is {np.median(away):.0f} m away in the median; are "
            "unit, frame and the order of east and north the same?"
        )
    return located


def _chainages(config: ReportConfig, manifest: dict[str, Any], bore: Bore, design: Design | None) -> np.ndarray:
    """Return the chainage at each station, m: the design's unless `start` is given; it may fall along the bore."""
    if config.start is None and design is not None:
        return design.chainages(bore)
    found = manifest.get("detected", {}).get("chainage_start") or 0.0
    return bore.station + float(found if config.start is None else config.start)


def _read_section(bore: Bore, config: ReportConfig) -> sections.DesignSection:
    if config.section is not None and config.radius is not None:
        raise FitError("--section and --radius exclude each other")
    if config.radius is not None:
        return sections.circle_section(bore, config.radius)
    if config.section is not None:
        gauge = read_gauge(config.section)  # the same form: a closed polygon
        return sections.polygon_section(bore, gauge.points, config.section.name)
    return sections.own_section(bore)


def _facts(
    bore: Bore, manifest: dict[str, Any], section: str, chainage: np.ndarray, fit: AlignmentFit
) -> dict[str, str]:
    kinds = [element.kind for element in fit.plan.elements]
    return {
        "length": f"{bore.length:.2f} m, chainage {chainage[0]:.2f} to {chainage[-1]:.2f} m",
        "recording": str(manifest.get("input_provenance", "unknown")),
        "stations that were interpolated": f"{bore.filled.mean():.0%}",
        "design section": section,
        "width": f"{bore.width.mean():.3f} m in the mean, {bore.width.min():.3f} to {bore.width.max():.3f} m",
        "height": f"{bore.height.mean():.3f} m in the mean, {bore.height.min():.3f} to {bore.height.max():.3f} m",
        "alignment": f"{', '.join(_count(kinds, kind) for kind in ('line', 'arc', 'clothoid'))}; "
        f"the axis is {1e3 * fit.plan.rms:.1f} mm off in plan and {1e3 * fit.profile.rms:.1f} mm in height, RMS"
        + (_WANDERS if np.median([element.length for element in fit.plan.elements]) < _SHORT else ""),
    }  # fmt: skip


def _count(kinds: list[str], kind: str) -> str:
    number = kinds.count(kind)
    return f"{number} {kind}{'' if number == 1 else 's'}"


def _write_offsets(folder: Path, bore: Bore, design: Design, located: np.ndarray) -> dict[str, str]:
    rows = ((f"{s:.3f}", *(f"{value:.4f}" for value in place)) for s, place in zip(bore.station, located, strict=True))
    _write_rows(folder / "offsets.csv", ("station [m]", "chainage [m]", "right [m]", "above [m]"), rows)
    above = located[:, 2] if design.has_heights else None
    drawings.draw_offsets(folder / "offsets.png", located[:, 0], located[:, 1], above, design.name)
    grows = "with" if located[-1, 0] > located[0, 0] else "against"
    spread = f"{1e3 * np.median(located[:, 1]):+.0f} mm to the right in the median"
    return {"design axis": f"{design.name}; its chainage grows {grows} the stations; the axis lies {spread}"}


def _write_clearance(folder: Path, rails: Rails | None, bore: Bore, gauge: Any, chainage: np.ndarray) -> dict[str, str]:
    if rails is None:
        return {"clearance": "no track was laid in this scene"}
    free = clearance(bore, rails, gauge, bend(bore, rails))
    wanted = sections.at_round_chainages(bore, chainage, 1.0)
    at = np.interp(wanted, bore.station, chainage)
    near = free[sections.nearest_rows(bore, wanted)]
    rows = (tuple(f"{value:.4f}" for value in (c, *place)) for c, place in zip(at, near, strict=True))
    _write_rows(folder / "clearance.csv", ("chainage [m]", "free [m]", "left of the axis [m]", "above it [m]"), rows)
    drawings.draw_clearance(folder / "clearance.png", chainage, free[:, 0], gauge.name)
    worst = int(np.argmin(free[:, 0]))
    return {"clearance": f"{free[worst, 0]:.3f} m at least, at chainage {chainage[worst]:.2f} m ({gauge.name})"}


def _write_rows(path: Path, head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)


def _element_rows(fit: AlignmentFit, chainage: np.ndarray) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
    """Return elements in plan and in profile by their stations; their chainages fall where the design's do."""
    rows: tuple[list[tuple[str, ...]], list[tuple[str, ...]]] = ([], [])
    way = float(np.sign(chainage[-1] - chainage[0]))
    for number, part in enumerate((fit.plan, fit.profile)):
        describe = _describe_bend if number == 0 else _describe_grade
        for one, open_ in zip(part.elements, part.spread, strict=True):
            length = f"{one.length:.2f} ± {open_.length:.2f} m"
            ends = describe(one.first, open_.first), describe(one.last, open_.last)
            rows[number].append((one.kind, f"{chainage[0] + way * one.start:.2f} m", length, *ends))
    return rows


def _describe_bend(curvature: float, spread: float) -> str:
    if abs(curvature) < 1e-6:
        return "straight"
    radius = abs(1.0 / curvature)
    return f"{'left' if curvature > 0.0 else 'right'}, {radius:.1f} ± {radius**2 * spread:.1f} m"


def _describe_grade(grade: float, spread: float) -> str:
    return f"{grade:+.3%} ± {spread:.3%}"


def main(words: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    config = parse(
        lambda given: tyro.cli(ReportConfig, prog="python -m scene.report", args=given, description=__doc__), words
    )

    def act() -> None:
        print(report(config) / "report.html")

    return run_command(act, "interrupted; the output is as it was")


if __name__ == "__main__":
    sys.exit(main())
