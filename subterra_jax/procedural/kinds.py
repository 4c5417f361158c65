"""Kinds of lining: the ranges that tunnels of the open world are drawn from, each with its source.

A pair is the least and the largest value; draws are uniform unless said. Nothing here knows where a sensor looks.

Sources, by the letter that stands behind a range:
    A  Guangzhou metro line 21 (inner diameter 5.4 m, rings of 1.5 m) and Shanghai metro (5.5 m, rings of 1.2 m).
    B  Tunnels & Tunnelling, on large road tunnels: rings of 2.0 m; bolts may be temporary and their pockets filled.
    C  The paper: pockets 13 cm deep; the packaged bore's are 0.20 m long and 0.22 m from the joint.
    D  NFPA 130: cross-passages at most 244 m apart.
    E  Dybeł et al. 2021, Studia Geotechnica et Mechanica 43: blasting rounds of 3 m; the contour of a round opens
       towards its end (Kim and Bruland's contour quality index).
    F  AFTES GT36R1 on cast linings: a form is moved on block by block. The figures are from memory, not looked up.
    M  Engineering practice, from memory, not looked up.
"""

from __future__ import annotations

import dataclasses

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class SectionRanges:
    """Outline of the section."""

    width: Range  # largest inner width, m
    height: Range | None = None  # height from floor to crown, m; `None` for a circle, whose invert is filled
    spring: Range = (0.4, 0.6)  # height of the springing over that of the crown, 1
    foot: Range = (0.0, 0.0)  # distance by which the walls draw in towards the floor, m
    fill: Range = (0.0, 0.0)  # depth of the invert's filling, m; for a circle


@dataclasses.dataclass(frozen=True)
class SurfaceRanges:
    """Roughness of the wall: two Gaussian random surfaces, a fine and a coarse one."""

    fine_sd: Range  # standard deviation of the fine one, m
    fine_length: Range  # its correlation length, m, drawn uniformly in its logarithm
    coarse_sd: Range  # standard deviation of the coarse one, m
    coarse_length: Range  # its correlation length, m


@dataclasses.dataclass(frozen=True)
class RingRanges:
    """Rings of segments."""

    nominal: Range  # nominal ring length, m, to a centimetre
    gasket: Range  # systematic excess of the built length over the nominal, 1
    length_sd: float  # standard deviation of the length of one ring, m
    segments: tuple[int, int]  # fewest and most segments of a ring, the key among them
    step_sd: Range  # standard deviation of the radial place of one segment, m; neighbours step by 1.4 times as much
    oval: Range  # excess of the horizontal over the mean radius, 1
    turned: bool  # true for universal rings: each ring is turned to the place of its key segment
    dowel_fraction: float  # fraction of tunnels whose ring joints have dowels, which leave no pockets


@dataclasses.dataclass(frozen=True)
class PocketRanges:
    """Pockets of the bolts."""

    bolts: tuple[int, int]  # fewest and most bolts around a ring joint
    length: Range  # length along the tunnel, m
    width: Range  # width around the section, m
    depth: Range  # depth, m
    offset: Range  # distance of the middle from its joint, m
    missing: Range  # fraction of pockets that are missing or grouted flush
    grouted_fraction: float  # fraction of tunnels in which nearly all (95 %) are grouted


@dataclasses.dataclass(frozen=True)
class StretchRanges:
    """Lining that is made stretch by stretch, each a little aside from the last."""

    length: Range  # length of a stretch in one tunnel, m
    jitter: float  # standard deviation of one stretch's length, over that length, 1
    offset_sd: Range  # standard deviation of a stretch's radial place, m, the same all around
    shift_sd: Range  # standard deviation of its place aside and upright, m
    flare: Range = (0.0, 0.0)  # growth of the radius from the begin of a stretch to its end, m
    repaired: Range = (0.0, 0.0)  # fraction of stretches with a ring of repair inside the wall
    thickness: Range = (0.0, 0.0)  # thickness of such a ring, m


@dataclasses.dataclass(frozen=True)
class PatchRanges:
    """Patches on the wall."""

    spacing: Range  # length of tunnel for each patch, m
    size: Range  # length along and around, m
    relief: Range  # standard deviation of how far it stands out or in, m


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of lining."""

    name: str  # name in names of tunnels
    title: str  # name in words
    section: SectionRanges  # its section
    surface: SurfaceRanges  # its roughness
    # step of the grid of stations on which the wall is known, m; a step of the wall is a ramp of this length
    step: float
    rings: RingRanges | None = None  # rings of segments, if any
    pockets: PocketRanges | None = None  # pockets of bolts, if any
    stretches: StretchRanges | None = None  # blocks, rounds or repaired stretches, if any
    patches: PatchRanges | None = None  # patches, if any
    fixtures: tuple[str, ...] = ()  # furniture that may be drawn, by name
    always: tuple[str, ...] = ()  # furniture that belongs to the lining itself


_METRO = SectionRanges(width=(5.2, 6.0), fill=(0.7, 1.1))  # A; fill M
_CONCRETE = SurfaceRanges((0.0005, 0.002), (0.5, 2.0), (0.001, 0.004), (5.0, 20.0))  # M
_BOLTS = PocketRanges(
    bolts=(10, 19),  # A: 10 and 17
    length=(0.15, 0.25),  # C, M
    width=(0.15, 0.25),  # M
    depth=(0.08, 0.15),  # C, M
    offset=(0.21, 0.28),  # C
    missing=(0.0, 0.3),  # M
    grouted_fraction=0.15,  # B says that it happens; the fraction is ours
)
_STRAIGHT = RingRanges(
    nominal=(1.0, 2.0),  # A, B
    gasket=(0.0, 0.002),  # M: 0 to 3 mm a joint
    length_sd=0.001,  # M
    segments=(6, 7),  # A
    step_sd=(0.0015, 0.005),  # M: steps of 2 to 10 mm between neighbours
    oval=(0.0, 0.004),  # M
    turned=False,
    dowel_fraction=0.0,
)
_LINESIDE = ("cabinet", "signal", "bracket", "walkway", "trough")
_METRO_FIXTURES = ("cross-passage", *_LINESIDE)

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "straight",
            "segments, straight joints",
            _METRO,
            _CONCRETE,
            0.125,
            rings=_STRAIGHT,
            pockets=_BOLTS,
            fixtures=_METRO_FIXTURES,
        ),
        Kind(
            "universal",
            "segments, universal rings",
            _METRO,
            _CONCRETE,
            0.125,
            # Dowels instead of bolts in ring joints are common with universal rings (M); the fraction is ours.
            rings=dataclasses.replace(_STRAIGHT, turned=True, dowel_fraction=0.5),
            pockets=_BOLTS,
            fixtures=_METRO_FIXTURES,
        ),
        Kind(
            "cast",
            "cast in place",
            SectionRanges(width=(5.0, 7.0), height=(5.5, 7.0), foot=(0.0, 0.4)),  # M: single track
            _CONCRETE,
            0.125,
            # F: blocks of 6 to 12 m; steps of 5 to 30 mm between blocks.
            stretches=StretchRanges((6.0, 12.0), 0.003, (0.002, 0.008), (0.003, 0.01)),
            patches=PatchRanges((5.0, 40.0), (0.4, 2.0), (0.002, 0.008)),  # M
            fixtures=("refuge", "cross-passage", *_LINESIDE),
        ),
        Kind(
            "sprayed",
            "sprayed concrete",
            SectionRanges(width=(5.0, 7.5), height=(5.5, 7.5), foot=(0.0, 0.5)),  # M
            SurfaceRanges((0.02, 0.06), (0.3, 2.0), (0.01, 0.04), (3.0, 8.0)),  # M
            0.1,
            # Rounds of 1 to 3 m (E: 3 m; shorter in soft ground, M), which open by 10 to 30 cm towards their ends (M).
            stretches=StretchRanges((1.0, 3.0), 0.1, (0.01, 0.04), (0.01, 0.03), flare=(0.1, 0.3)),
            fixtures=("refuge", "cross-passage", *_LINESIDE),
        ),
        Kind(
            "masonry",
            "masonry",
            SectionRanges(width=(4.5, 5.4), height=(5.2, 6.2), foot=(0.1, 0.4)),  # M: old single track
            SurfaceRanges((0.004, 0.012), (0.3, 1.0), (0.01, 0.03), (4.0, 10.0)),  # M
            0.125,
            # M: relined stretches of one or two rings of brick, 11 cm each, half of it within the old face.
            stretches=StretchRanges(
                (4.0, 10.0), 0.3, (0.002, 0.006), (0.004, 0.012), repaired=(0.05, 0.25), thickness=(0.04, 0.11)
            ),
            patches=PatchRanges((5.0, 30.0), (0.5, 3.0), (0.005, 0.02)),  # M
            fixtures=_LINESIDE,
            always=("refuge", "buttress"),
        ),
        Kind(
            "rock",
            "rock",
            SectionRanges(width=(5.5, 8.0), height=(5.5, 7.5)),  # M
            SurfaceRanges((0.03, 0.08), (0.3, 1.0), (0.05, 0.1), (1.0, 3.0)),  # M: 10 to 40 cm from hollow to hump
            0.1,
            stretches=StretchRanges((2.0, 5.0), 0.1, (0.01, 0.05), (0.01, 0.04), flare=(0.1, 0.3)),  # E, M
            fixtures=("refuge", "cross-passage", *_LINESIDE),
        ),
    )
}


@dataclasses.dataclass(frozen=True)
class FixtureRanges:
    """Things of one sort that stand or hang at the wall, or niches in it."""

    spacing: Range  # distance from one to the next on one side, m; drawn once a tunnel
    jitter: float  # standard deviation of each one's place, over the spacing, 1
    length: Range  # length along the tunnel, m
    depth: Range  # height out of the wall, m; below 0 it is the depth of a niche
    low: Range  # lower end above the floor, m
    high: Range  # upper end above the floor, m
    sides: int  # number of sides it stands on: 1, or 2 with the sides staggered by half a spacing


FIXTURES = {
    "refuge": FixtureRanges((20.0, 30.0), 0.04, (0.8, 1.5), (-0.9, -0.5), (0.1, 0.2), (1.9, 2.2), 2),  # M
    "cross-passage": FixtureRanges((150.0, 244.0), 0.1, (1.4, 2.4), (-1.0, -0.3), (0.1, 0.3), (2.0, 2.5), 1),  # D, M
    "buttress": FixtureRanges((10.0, 60.0), 0.1, (0.3, 0.7), (0.05, 0.2), (-0.1, 0.0), (2.5, 3.5), 2),  # M
    "cabinet": FixtureRanges((40.0, 150.0), 0.2, (0.5, 1.2), (0.2, 0.5), (0.0, 0.8), (1.0, 1.9), 1),  # M
    "signal": FixtureRanges((150.0, 400.0), 0.1, (0.2, 0.4), (0.2, 0.4), (0.0, 1.0), (1.2, 2.8), 1),  # M
    "bracket": FixtureRanges((0.8, 2.0), 0.01, (0.04, 0.08), (0.1, 0.35), (0.3, 1.5), (1.6, 3.0), 1),  # M
}
# A walkway or a covered cable trough runs the whole length along one wall: width and height of its top, m (M).
BENCHES = {"walkway": ((0.6, 0.95), (0.2, 1.1)), "trough": ((0.25, 0.45), (0.15, 0.35))}

LENGTH: Range = (300.0, 3000.0)  # m, drawn uniformly in its logarithm
MOUNT_HEIGHT: Range = (0.4, 1.2)  # m above the floor
MOUNT_LATERAL: Range = (-0.3, 0.3)  # m to the left of the robot's middle
MOUNT_TILT = 0.02  # rad, standard deviation of roll and of pitch, cut at three
