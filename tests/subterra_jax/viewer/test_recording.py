"""An episode on disk."""

import numpy as np
import pytest

from subterra_jax.viewer.recording import EpisodeFileError, load, save
from tests.subterra_jax.viewer.episodes import straight


def test_an_episode_comes_back_as_it_was_saved(tmp_path):
    episode = straight()
    save(episode, tmp_path / "folder" / "a.npz")
    again = load(tmp_path / "folder" / "a.npz")
    for name, value in vars(episode).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["a.npz"]


def test_the_same_episode_has_the_same_bytes_and_name(tmp_path):
    for name in ("a.npz", "b.npz"):
        save(straight(), tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert straight().file_name == "StopAt-v1_by-hand_t_smooth_3.npz"
    assert "/" not in straight(tunnel="../../etc/passwd").file_name


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        ({"schema": np.array("other/1")}, "field 'schema' must be"),
        ({"heading": None}, "field 'heading' is missing"),
        ({"position": np.zeros((21, 3), np.float32)}, "field 'position' must have shape"),
        ({"station": np.zeros(20, np.float32)}, "must have one length"),
        ({"station": np.full(21, np.nan, np.float32)}, "not finite"),
        ({"period": np.array(0.0)}, "field 'period' must be positive"),
        ({"task": np.array(1.0)}, "field 'task' must have shape"),
        ({"ranges": np.array([object()])}, "not a readable recording"),
    ],
)
def test_a_spoiled_recording_is_refused_by_file_and_field(tmp_path, spoil, says):
    fields = {"schema": np.array("subterra.episode/1"), **{k: np.asarray(v) for k, v in vars(straight()).items()}}
    np.savez(tmp_path / "a.npz", **{name: v for name, v in {**fields, **spoil}.items() if v is not None})
    with pytest.raises(EpisodeFileError, match=f"a.npz: .*{says}"):
        load(tmp_path / "a.npz")


def test_what_is_no_archive_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 but no more")
    with pytest.raises(EpisodeFileError, match="not a readable recording"):
        load(tmp_path / "a.npz")
    with pytest.raises(EpisodeFileError, match="no such recording"):
        load(tmp_path / "b.npz")
