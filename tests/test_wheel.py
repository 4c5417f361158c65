"""What is installed where there is no checkout."""

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_wheel_holds_the_simulator_and_its_tunnels_alone(tmp_path):
    flags = ("--quiet", "--no-deps", "--no-build-isolation", "-w", str(tmp_path))
    subprocess.run([sys.executable, "-m", "pip", "wheel", *flags, str(ROOT)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert tops == {"subterra_jax"}
    assert any(name.startswith("subterra_jax/data/") and name.endswith(".npz") for name in names)
