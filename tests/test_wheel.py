"""The installed wheel, where there is no checkout."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DRIVE = """
import warnings
warnings.simplefilter("error", UserWarning)
import subterra_jax as st
import jax
from subterra_jax import policies
env, params = st.make("Subterra/TraverseShort-v1")
obs, state = env.reset(jax.random.key(0), params)
obs, state, *_ = env.step(jax.random.key(1), state, env.action_space(params).high, params)
agent, facts = policies.load("TraverseShort-v1")
print(obs.shape, agent.name, facts["task"])
"""
TOUR = """
import jax, numpy as np
import subterra_jax as st
from subterra_jax.parts.spatial_lidar import SENSORS
for id in st.list_tasks():
    for sensor in SENSORS if "B2Walk" not in id else SENSORS[:1]:  # it has no LiDAR
        env, params = st.make(id, **({} if sensor == SENSORS[0] else {"sensor": sensor}))
        _, state = env.reset(jax.random.key(0), params)
        obs, *_ = env.step(jax.random.key(1), state, jax.numpy.zeros(getattr(env, "action_size", 12)), params)
        print(id, sensor, np.isfinite(obs).all())
"""


@pytest.fixture(scope="module")
def packages(tmp_path_factory) -> list[Path]:
    """The sdist, and the wheel that is built from it."""
    out = tmp_path_factory.mktemp("dist")
    words = ("-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT))
    subprocess.run([sys.executable, *words], check=True, capture_output=True)
    return sorted(out.iterdir())


def test_the_wheel_holds_the_simulator_and_its_tunnels_alone(packages):
    (wheel,) = [path for path in packages if path.suffix == ".whl"]
    assert wheel.stat().st_size <= 10_000_000
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert tops == {"subterra_jax"}
    assert any(name.startswith("subterra_jax/data/") and name.endswith(".npz") for name in names)
    assert any(name.startswith("subterra_jax/data/policies/") for name in names)


def test_the_sdist_holds_what_the_wheel_is_made_of(packages):
    (sdist,) = [path for path in packages if path.name.endswith(".tar.gz")]
    with tarfile.open(sdist) as archive:
        tops = {name.split("/")[1] for name in archive.getnames() if "/" in name}
    assert {"subterra_jax", "pyproject.toml", "README.md", "LICENSE"} <= tops
    assert not tops & {"tests", "scene", "train", "benchmarks"}


def test_an_index_would_take_both(packages):
    words = ("-m", "twine", "check", "--strict", *map(str, packages))
    done = subprocess.run([sys.executable, *words], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("PASSED") == 2


def test_the_simulator_is_imported_quickly_and_says_nothing(tmp_path):
    line = "import time; t = time.process_time(); import subterra_jax; print(time.process_time() - t)"
    words = (sys.executable, "-X", "importtime", "-W", "error::UserWarning", "-c", line)
    done = subprocess.run(words, check=True, capture_output=True, text=True, cwd=tmp_path)
    assert float(done.stdout) < 2.0  # s of a processor: what else runs here does not count
    noise = [outcome for outcome in done.stderr.splitlines() if not outcome.startswith("import time:")]
    assert noise == []
    # What takes long to import and is needed by some only.
    loaded = {outcome.split("|")[-1].strip().split(".")[0] for outcome in done.stderr.splitlines()}
    assert not loaded & {"mujoco", "torch", "matplotlib", "brax", "numba"}


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_wheel_alone_loads_a_policy_and_makes_and_steps_every_task_with_every_sensor(packages, tmp_path):
    """Needs a package index."""
    (wheel,) = [path for path in packages if path.suffix == ".whl"]
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "fresh")], check=True)
    python = str(tmp_path / "fresh" / "bin" / "python")
    subprocess.run([python, "-m", "pip", "install", "--quiet", str(wheel)], check=True)
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    done = subprocess.run([python, "-c", DRIVE], check=True, capture_output=True, text=True, cwd=tmp_path, env=plain)
    assert done.stdout.startswith("(18,) ")
    assert done.stderr == ""
    done = subprocess.run([python, "-c", TOUR], check=True, capture_output=True, text=True, cwd=tmp_path, env=plain)
    assert [line.split()[-1] for line in done.stdout.splitlines()] == ["True"] * (9 * 5 + 1)
