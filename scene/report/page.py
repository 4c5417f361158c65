"""`report.html`: sizes, the worst places first, alignment, clearance, and what lies beside it."""

import base64
from pathlib import Path

import numpy as np

from scene.judging.drawing import text
from scene.judging.page import STYLE, make_table

_WORST = 12
_APART = 5.0  # m between two worst places
_SPREAD = (
    "±: one standard deviation, by what the elements leave of the axis, if their number and kinds are right. A "
    "clothoid between bends of nearly one slope has no sharp end, and its length is then as open as it says."
)


def write_report(
    folder: Path,
    name: str,
    facts: dict[str, str],
    table: np.ndarray,
    elements: tuple[list[tuple[str, ...]], list[tuple[str, ...]]],
) -> None:
    """Write the page; pictures of the folder are put into it.

    Args:
        folder: The folder, with its pictures.
        name: Name of the tunnel.
        facts: Rows of the first table.
        table: Rows of `sections.ROW`.
        elements: Rows of the tables of the alignment, in plan and in profile.
    """
    parts = [f"<h1>{text(name)}</h1>", make_table("In short", list(facts.items()))]
    worst = _apart(table["station"], np.maximum(table["deviation_most"], -table["deviation_least"]))
    rows = [
        (f"{table['chainage'][k]:.2f} m", f"{100 * table['deviation_most'][k]:+.1f} cm",
         f"{100 * table['deviation_least'][k]:+.1f} cm", f"{table['over'][k]:.3f} m²", f"{table['under'][k]:.3f} m²",
         "interpolated" if table["filled"][k] else f"{table['coverage'][k]:.0%} seen")
        for k in worst
    ]  # fmt: skip
    head = ("chainage", "most outwards", "most inwards", "overbreak", "underbreak", "evidence")
    parts.append(make_table("Worst places", [head, *rows]))
    titles = {
        "unrolled.png": "Deviation from the design, rolled out", "offsets.png": "Against the design axis",
        "alignment.png": "Alignment fitted to the axis", "clearance.png": "Clearance",
    }  # fmt: skip
    for file, title in titles.items():
        if (folder / file).exists():
            picture = base64.b64encode((folder / file).read_bytes()).decode()
            parts.append(
                f'<h2>{title}</h2><img style="width:100%" alt="{title}" src="data:image/png;base64,{picture}">'
            )
        if file == "alignment.png":
            for title, some in zip(("Elements in plan", "Elements in profile"), elements, strict=True):
                parts.append(make_table(title, [("element", "begins", "length", "from", "to"), *some]))
            parts.append(f"<p>{_SPREAD}</p>")
    files = [(file.name, _FILES.get(file.name, "")) for file in sorted(folder.iterdir())]
    parts.append(make_table("Beside this page", files))
    page = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{text(name)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>'
        f"<body>{''.join(parts)}</body></html>\n"
    )
    (folder / "report.html").write_text(page, encoding="utf-8")


def _apart(station: np.ndarray, size: np.ndarray) -> list[int]:
    """Return the rows of the largest sizes, each at least `_APART` from those before it."""
    chosen: list[int] = []
    for row in np.argsort(-size):
        if len(chosen) == _WORST:
            break
        if all(abs(station[row] - station[one]) >= _APART for one in chosen):
            chosen.append(int(row))
    return chosen


_FILES = {
    "tunnel.ifc": "IFC 4.3: alignment, inner surface of the lining, clear bore, rails and sleepers",
    "alignment.png": "the picture above",
    "clearance.png": "the picture above",
    "offsets.png": "the picture above",
    "unrolled.png": "the picture above",
    "sections.csv": "a row for each metre of chainage",
    "rings.xlsx": "the same, and a row for each ring, as a spreadsheet",
    "points.laz": "the cloud, thinned to one point a 6 cm voxel, with station, offset, height and deviation",
    "alignment.xml": "LandXML 1.2: lines, arcs and clothoids, grades and parabolas",
    "sections.dxf": "sections as measured and as designed, every 10 m, looking ahead",
    "plan_profile.dxf": "plan and profile with chainage",
    "unrolled.tif": "deviation from the design in m, rows along the bore, columns around it from the floor",
    "clearance.csv": "least free distance around the gauge at each metre",
    "offsets.csv": "the axis against the design axis",
}
