"""The bore in three dimensions as fields of `tunnel.npz`: section, recesses, and what the scenes draw as boxes."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.bore import Bore
from scene.writing.track import TrackConfig
from scene.writing.unrolled import unroll_section

_SEEN = ("0", "1")  # groups of geoms that a camera sees


@dataclass(frozen=True)
class Variant:
    """One lining of the tunnel file."""

    bore: Bore  # With the recesses that its wall is rolled out with
    recesses: bool  # True where they are cut
    scene: Path  # MJCF file that draws it


def seams(variants: dict[str, Variant]) -> dict[str, float]:
    """Return the angle at which the wall of each variant is cut open to be rolled out flat, rad, by field."""
    return {f"shell_seam_{name}": float(unroll_section(each.bore).angle[0]) for name, each in variants.items()}


def shell_fields(
    bore: Bore, elevation: Float[np.ndarray, " n"], track: TrackConfig, variants: dict[str, Variant]
) -> dict[str, np.ndarray]:
    """Return the bore in three dimensions as arrays by field name; docs/formats.md says what each means.

    `variants` are keyed by the names of the linings; boxes that all of them draw are the track.
    """
    scenes = {variant.scene: _read_bricks(variant.scene, track) for variant in variants.values()}
    common = set.intersection(*(set(bricks) for bricks in scenes.values()))
    first = next(iter(scenes.values()))
    fields: dict[str, np.ndarray] = {
        "shell_height": bore.position[:, 2] - elevation,
        "shell_rise": bore.tangent[:, 2],
        "shell_angle": bore.angle,
        "shell_section": bore.radius.mean(axis=0),
        "shell_radius": bore.radius,
        "shell_track": _rows([row for name, row in first.items() if name in common]),
    }
    for name, variant in variants.items():
        pocket = variant.bore.pocket if variant.recesses else variant.bore.pocket[:0]
        columns = [pocket[field] for field in ("station", "angle", "length", "width", "depth")]
        fields[f"shell_pocket_{name}"] = np.stack(columns, axis=-1)
        own = [row for brick, row in scenes[variant.scene].items() if brick not in common]
        fields[f"shell_brick_{name}"] = _rows(own)
    return fields


def _rows(rows: list[np.ndarray]) -> Float[np.ndarray, "k 13"]:
    return np.array(rows, float).reshape(-1, 13)


def _read_bricks(scene: Path, track: TrackConfig) -> dict[str, Float[np.ndarray, "13"]]:
    """Return visible boxes and sleepers of a scene by name: middle, half edges as three vectors, taper."""
    bricks = {}
    width = (track.sleeper_top + track.sleeper_bottom) / 4
    sleeper = np.array([width, track.sleeper_length / 2, track.sleeper_height / 2])
    for geom in ET.parse(scene).getroot().iterfind("worldbody/geom"):
        is_box = geom.get("type") == "box" and geom.get("group") in _SEEN
        if not (is_box or geom.get("mesh") == "sleeper"):
            continue
        w, x, y, z = np.array(geom.get("quat", "1 0 0 0").split(), float)
        frame = Rotation.from_quat([x, y, z, w]).as_matrix()
        centre = np.array(geom.get("pos", "0 0 0").split(), float)
        half = np.array(geom.get("size", "0 0 0").split(), float) if is_box else sleeper
        if not is_box:
            centre = centre - sleeper[2] * frame[:, 2]
        taper = 0.0 if is_box else 1.0 - track.sleeper_top / 2 / width
        bricks[geom.get("name", "")] = np.array([*centre, *(frame * half).T.ravel(), taper])
    return bricks
