"""Rings and pockets of the lining, found on the wall rolled out flat."""

from dataclasses import replace

from scene.bore import Bore
from scene.section import Sections


def add_features(bore: Bore, sections: Sections) -> tuple[Bore, dict[str, str]]:
    return replace(bore), {"rings": "none", "pockets": "none"}
