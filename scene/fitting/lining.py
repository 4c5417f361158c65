"""Lining of segments: rings, pockets and nails, measured where the survey shows them, by standard where it cannot."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Shaped

from scene.bore import POCKET, Bore
from scene.cloud import Cloud
from scene.fitting import nails, pockets
from scene.fitting.section import Sections
from scene.fitting.sectiontype import FREE

MEASURED, STANDARD, NONE = "measured", "by standard", "none found"


@dataclass(frozen=True)
class LiningConfig:
    """The lining that stands where the survey can show none.

    Attributes:
        by_standard: Whether such a lining is put in at all. It is not where the survey could have shown one and did
            not, nor where the walls are no even section.
        ring_width: m. Source: 1.5 m, Guangzhou line 21; 1.2–1.5 m in use.
        pockets_per_ring: On each side of a joint, spread evenly over the crown between the lowest two. An assumption:
            metro rings have 10 to 17 longitudinal bolts, the lowest below the track.
        pocket_size: Length along and width around, m. An assumption: openings of 0.15–0.25 m are usual.
        pocket_depth: m. Source: 13 cm, the paper, Sec. II.
        pocket_offset: Of a pocket's middle from the joint, m. An assumption.
        clock_angle: Of the lowest pockets below the horizontal, rad. An assumption: where the plane of a robot's LiDAR
            meets the wall in a section of 5.65 m × 6.36 m. In a round one of 5.8 m that is at 0.61; at 0.70 the plane
            passes between two rows and the lining is smooth to the robot.
        stagger: Shift of every second joint's pockets, as a share of their spacing; 0 for straight rows.
        nail_diameter: m. Source: bolts M24 to M30.
        nail_depth: Of the nail's axis behind the wall, m. An assumption: about the middle of the pocket.
    """

    by_standard: bool = True
    ring_width: float = 1.5
    pockets_per_ring: int = 8
    pocket_size: tuple[float, float] = (0.20, 0.18)
    pocket_depth: float = 0.13
    pocket_offset: float = 0.22
    clock_angle: float = 0.70
    stagger: float = 0.0
    nail_diameter: float = 0.027
    nail_depth: float = 0.06


def add_features(
    bore: Bore, sections: Sections, cloud: Cloud | None = None, config: LiningConfig | None = None
) -> tuple[Bore, dict[str, str]]:
    """The bore with its lining, and where rings, pockets and nails come from.

    Args:
        bore: Smooth.
        sections: What it was made of.
        cloud: In which nails are looked for; without it they are by standard.
        config: See `LiningConfig`.
    """
    config = config or LiningConfig()
    found, joints = pockets.find_pockets(sections)
    if len(found):
        bore = replace(bore, pocket=found, ring_station=joints)
        return _nailed(bore, cloud, config, {"rings": MEASURED, "pockets": MEASURED})
    if pockets.could_show(sections, config.pocket_depth):
        return bore, {"rings": NONE, "pockets": NONE, "nails": NONE}
    return standard(bore, config, sections.flat_floor)


def standard(bore: Bore, config: LiningConfig, flat_floor: bool) -> tuple[Bore, dict[str, str]]:
    """The bore with the lining of the configuration, marked as not measured; ring stations that it has are kept.

    Args:
        bore: Smooth.
        config: See `LiningConfig`.
        flat_floor: Whether the lowest part of the section is a floor, which has no pockets.
    """
    rings = {"rings": MEASURED} if len(bore.ring_station) else {"rings": STANDARD}
    joints = np.arange(config.ring_width / 2, bore.length, config.ring_width)
    types = bore.section_type[np.clip(np.searchsorted(bore.station, joints), 0, len(bore.station) - 1)]
    joints = joints[types != FREE]
    laid = _rows(bore, joints, config, flat_floor)
    if not config.by_standard or not len(laid):
        kept = rings if len(bore.ring_station) else {"rings": "none"}
        return bore, {**kept, "pockets": "none: the survey cannot show them", "nails": "none"}
    bore = replace(bore, pocket=laid, ring_station=bore.ring_station if len(bore.ring_station) else joints)
    return _nailed(bore, None, config, {**rings, "pockets": STANDARD})


def _rows(
    bore: Bore, joints: Float[np.ndarray, " j"], config: LiningConfig, flat_floor: bool
) -> Shaped[np.ndarray, " p"]:
    """Pockets on both sides of each joint, in rows."""
    rows = np.linspace(-config.clock_angle, np.pi + config.clock_angle, max(config.pockets_per_ring, 1))
    spacing = rows[1] - rows[0] if len(rows) > 1 else 0.0
    turn = np.where(np.arange(len(joints)) % 2 == 1, config.stagger * spacing, 0.0)
    station = joints[:, None, None] + config.pocket_offset * np.array([-1.0, 1.0])[None, :, None] + 0 * rows
    angle = np.angle(np.exp(1j * (rows[None, None] + turn[:, None, None]))) + 0 * station
    station, angle = station.ravel(), angle.ravel()
    length, width = config.pocket_size
    keep = (station > length) & (station < bore.length - length)
    if flat_floor:
        keep &= _above_floor(bore, station, angle) > pockets.FLOOR_MARGIN
    laid = np.zeros(int(keep.sum()), POCKET)
    laid["station"], laid["angle"], laid["depth"] = station[keep], angle[keep], config.pocket_depth
    laid["length"], laid["width"] = length, width
    return laid[np.lexsort((laid["angle"], laid["station"]))]


def _above_floor(bore: Bore, station: np.ndarray, angle: np.ndarray) -> Float[np.ndarray, " p"]:
    """Height of each place on the wall above the floor on the axis, m."""
    row = np.clip(np.searchsorted(bore.station, station), 0, len(bore.station) - 1)
    upward = bore.radius * np.sin(bore.angle)
    column = np.argmin(np.abs(np.angle(np.exp(1j * (angle[:, None] - bore.angle[None])))), axis=1)
    return upward[row, column] - upward[row].min(axis=1)


def _nailed(bore: Bore, cloud: Cloud | None, config: LiningConfig, provenance: dict[str, str]) -> tuple[Bore, dict]:
    pairs = nails.pairs(bore)
    found = nails.seen(bore, pairs, cloud) if cloud is not None else None
    if found is None:
        return replace(bore, nail=nails.laid(bore, pairs, config.nail_depth, config.nail_diameter)), {
            **provenance,
            "nails": STANDARD if len(pairs) else NONE,
        }
    result = nails.laid(bore, pairs, found.depth if found.present.any() else config.nail_depth, config.nail_diameter)
    result["measured"], result["confidence"] = found.present, np.where(found.present, found.confidence, 0.0)
    if not found.present.any():
        return bore, {**provenance, "nails": NONE}
    return replace(bore, nail=result[~found.absent]), {**provenance, "nails": f"{MEASURED}, those not seen {STANDARD}"}
