"""A build reads its recording twice at most, and goes on from poses and cloud where one before it was killed."""

import pytest

from scene import build as pipeline
from scene.build import build
from scene.config import BuildConfig
from scene.poses import place
from scene.reading.rosbag import RosBag
from tests.scene.conftest import Simulated

NAMED = BuildConfig(provenance="simulated")


class Killed(BaseException):
    """What ends a build as a signal does: nothing catches it."""


def test_a_build_reads_twice_and_the_one_after_a_kill_reads_nothing_and_writes_the_same(
    simulated: Simulated, tmp_path, monkeypatch, capsys
):
    passes = []
    scans = RosBag.scans

    def counted(self, only=None):
        passes.append("whole" if only is None else "some")
        return scans(self, only)

    def kill(*_):
        raise Killed

    survey, out = simulated.survey, tmp_path / "scene"
    monkeypatch.setattr(RosBag, "scans", counted)
    with monkeypatch.context() as until:
        until.setattr(pipeline, "clean_cloud", kill)
        with pytest.raises(Killed):
            build(survey / "survey.bag", out, survey / "groundtruth.tum", NAMED)
    assert passes.count("whole") == 2  # for the times of all sweeps, and to place them
    assert not out.exists()
    (kept,) = tmp_path.iterdir()

    monkeypatch.setattr(place, "register_scans", kill)
    passes.clear()
    build(survey / "survey.bag", out, survey / "groundtruth.tum", NAMED)
    assert not passes
    assert str(kept) in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [out]
    files = [file.relative_to(simulated.scene) for file in simulated.scene.rglob("*") if file.is_file()]
    assert all((out / file).read_bytes() == (simulated.scene / file).read_bytes() for file in files)


def test_other_settings_or_another_recording_take_nothing_that_was_kept(tmp_path):
    bag = tmp_path / "a.bag"
    bag.write_text("one")
    out = tmp_path / "scene"
    first = pipeline.find_kept(out, [bag], (0.04,))
    assert first == pipeline.find_kept(out, [bag], (0.04,))
    assert first != pipeline.find_kept(out, [bag], (0.05,))
    bag.write_text("other")
    assert first != pipeline.find_kept(out, [bag], (0.04,))
    first.write_text("stale")
    pipeline.forget_kept(out)
    assert list(tmp_path.iterdir()) == [bag]
