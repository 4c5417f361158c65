"""The real surveys that tests use where they are at hand; they are not part of the repository."""

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("SUBTERRA_SHARED", Path(__file__).parents[2] / "shared"))
METRO = SHARED / "data" / "metro_asbuilt"

needs_metro = pytest.mark.skipif(
    not METRO.is_dir(), reason="the metro survey is not here; SUBTERRA_SHARED names the folder that holds data/"
)
