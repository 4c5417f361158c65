"""The scene's robot as URDF: MuJoCo loads it, and it weighs and reaches what the scene's does."""

import json

import mujoco
import numpy as np
import pytest

from scene.errors import RecordingError
from scene.export import main, write_urdf

SCENE = """<mujoco><asset><material name="scout"/></asset><worldbody><body name="scout" pos="5 6 7"><freejoint/>
<geom name="hull" type="capsule" size="0.4 0.08" pos="0 0 0.52" mass="40" material="scout"/>
<geom type="sphere" size="0.08" pos="0.22 0.22 0.08" mass="1"/>
<geom type="sphere" size="0.08" pos="-0.22 0.1 0.08" mass="1"/>
<site name="lidar" pos="0 0 0.7" size="0.03"/><camera name="chase" pos="-4 0 2"/></body></worldbody></mujoco>"""


@pytest.fixture
def folder(tmp_path):
    built = tmp_path / "built"
    built.mkdir()
    (built / "scene.xml").write_text(SCENE)
    facts = {"name": "t", "input_provenance": "simulated", "frame": {"origin": [1.0, 2.0, 3.0]}}
    (built / "manifest.json").write_text(json.dumps(facts))
    return built


def test_it_loads_in_mujoco_with_mass_inertia_and_shapes_of_the_scenes(folder):
    out = folder.parent / "scout.urdf"
    assert main([str(folder), "--to", "urdf", "--out", str(out)]) == 0
    text = out.read_text()
    assert "simulated" in text
    # MuJoCo welds the base of a URDF to the world unless told otherwise, and leaves out what only looks.
    keep = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco></robot>'
    model = mujoco.MjModel.from_xml_string(text.replace("</robot>", keep))
    truth = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    link, body = model.body("base_link").id, truth.body("scout").id
    assert model.body_mass[link] == pytest.approx(truth.body_mass[body], rel=1e-6)
    assert model.body_ipos[link] == pytest.approx(truth.body_ipos[body], abs=1e-6)
    assert np.sort(model.body_inertia[link]) == pytest.approx(np.sort(truth.body_inertia[body]), rel=1e-5)
    assert model.body("lidar").pos == pytest.approx([0.0, 0.0, 0.7])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ends = [
        (data.geom_xpos[k, 2] - model.geom_rbound[k], data.geom_xpos[k, 2] + model.geom_rbound[k])
        for k in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    ]
    assert min(low for low, _ in ends) == pytest.approx(0.0, abs=1e-6)  # it stands on its casters
    assert max(high for _, high in ends) == pytest.approx(1.0, abs=1e-6)  # the crown of the capsule
    assert len(ends) == 8  # two balls of the capsule and two casters, each to be seen and to be touched


def test_a_scene_without_the_robot_is_refused_in_a_sentence(tmp_path):
    (tmp_path / "scene.xml").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(RecordingError, match="has no robot 'scout'"):
        write_urdf(tmp_path / "x.urdf", tmp_path / "scene.xml", "")
    (tmp_path / "scene.xml").write_text("<mujoco>")
    with pytest.raises(RecordingError, match="not a readable scene"):
        write_urdf(tmp_path / "x.urdf", tmp_path / "scene.xml", "")
    assert not (tmp_path / "x.urdf").exists()
