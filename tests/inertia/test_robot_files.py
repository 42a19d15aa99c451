"""Mass properties from model files of robots."""

import warnings

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import polhode as ph
from polhode.inertia import MassProperties

URDF = """<robot name="arm">
  <link name="base"/>
  <link name="hand">
    <inertial>
      <origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.5 0.6"/>
      <mass value="2.5"/>
      <inertia ixx="0.10" iyy="0.12" izz="0.07" ixy="0.01" ixz="-0.005" iyz="0.002"/>
    </inertial>
  </link>
  <joint name="wrist" type="continuous"><parent link="base"/><child link="hand"/></joint>
</robot>"""

MJCF = """<mujoco><worldbody><body name="hand" pos="1 2 3">
  <joint type="free"/>
  <geom type="box" size="0.1 0.2 0.3" mass="2" pos="0.5 0 0" euler="0 0 90"/>
</body></worldbody></mujoco>"""


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    return path


def test_a_link_of_a_urdf_file(arm):
    """The tensor refers to the axes of the inertial frame: roll about x first, fixed axes."""
    hand = MassProperties.from_urdf(arm, "hand")
    own = np.array([[0.10, 0.01, -0.005], [0.01, 0.12, 0.002], [-0.005, 0.002, 0.07]])
    turned = (
        Rotation.from_rotvec([0, 0, 0.6])
        * Rotation.from_rotvec([0, -0.5, 0])
        * Rotation.from_rotvec([0.4, 0, 0])
    ).as_matrix()
    np.testing.assert_allclose(hand.mass, 2.5)
    np.testing.assert_allclose(hand.centre, [0.1, -0.2, 0.3])
    np.testing.assert_allclose(hand.inertia.tensor, turned @ own @ turned.T, rtol=1e-12)


def test_mujoco_reads_the_same_link(arm):
    """MuJoCo's own URDF reader is the independent reference."""
    mujoco = pytest.importorskip("mujoco", reason="needs mujoco, extra robots")
    ours, theirs = MassProperties.from_urdf(arm, "hand"), mujoco.MjModel.from_xml_path(str(arm))
    hand = theirs.body("hand")
    turn = Rotation.from_quat(hand.iquat, scalar_first=True).as_matrix()
    tensor = turn @ np.diag(hand.inertia) @ turn.T
    np.testing.assert_allclose(ours.centre, hand.ipos, atol=1e-12)
    np.testing.assert_allclose(ours.inertia.tensor, tensor, rtol=1e-8, atol=1e-12)
    # it merges links with fixed joints, so that the mass of a link would be that of several
    with pytest.raises(ValueError, match=r"arm\.urdf is a URDF file, which is read by from_urdf"):
        MassProperties.from_mjcf(arm, "hand")


def test_a_body_of_an_mjcf_file(tmp_path):
    """Without an inertial element it follows from the geoms: a box rotated about z by 90 deg."""
    pytest.importorskip("mujoco", reason="needs mujoco, extra robots")
    path = tmp_path / "box.xml"
    path.write_text(MJCF)
    hand = MassProperties.from_mjcf(path, "hand")
    x, y, z = 0.2, 0.1, 0.3
    want = 2 / 3 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
    np.testing.assert_allclose(hand.centre, [0.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(hand.inertia.tensor, want, rtol=1e-9, atol=1e-12)
    scene = ph.Scene(hand.inertia)
    assert ph.simulate(scene, ph.State([1.0, 0, 0, 0], [0.1, 1.0, 0.1]), [0.0, 1.0]).successful
    with pytest.raises(ValueError, match="no body 'foot', it has: world, hand"):
        MassProperties.from_mjcf(path, "foot")
    path.write_text(MJCF.replace(' name="hand"', ""))
    with pytest.raises(ValueError, match="no body '', it has: world, and 1 without a name"):
        MassProperties.from_mjcf(path, "")


def test_robot_files_that_say_too_little(arm, tmp_path):
    with pytest.raises(ValueError, match="no link 'foot', it has: base, hand"):
        MassProperties.from_urdf(arm, "foot")
    with pytest.raises(ValueError, match=r"'base' of arm\.urdf has no <inertial>"):
        MassProperties.from_urdf(arm, "base")
    with pytest.raises(FileNotFoundError):
        MassProperties.from_urdf(tmp_path / "absent.urdf", "hand")
    arm.write_text(URDF.replace('value="2.5"', 'value="heavy"'))
    with pytest.raises(ValueError, match="needs a number value, got 'heavy'"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text(URDF.replace('ixx="0.10"', 'ixx="1.0"'))
    with pytest.raises(ValueError, match=r"'hand' of arm\.urdf: .* sum"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text(URDF.replace('value="2.5"', 'value="${mass}"'))
    with pytest.raises(ValueError, match=r"got '\$\{mass\}' \(expand the file by xacro first\)"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text(URDF.replace('rpy="0.4 -0.5 0.6"', 'rpy="0 0 ${pi/2}"'))
    with pytest.raises(ValueError, match=r"three numbers rpy, .* xacro"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text(URDF.replace('value="2.5"', 'value="0"'))
    with pytest.raises(ValueError, match=r"'hand' of arm\.urdf: mass must be positive"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text(MJCF)
    with pytest.raises(ValueError, match=r"is <mujoco>, .* <robot>; MJCF files are read by"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text("<sdf><model/></sdf>")
    with pytest.raises(ValueError, match=r"is <sdf>, a URDF file has <robot>\.$"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text("no XML")
    with pytest.raises(ValueError, match="not XML"):
        MassProperties.from_urdf(arm, "hand")


def test_a_link_is_read_without_a_warning_in_the_default_precision_of_jax(arm):
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("error")
        hand = MassProperties.from_urdf(arm, "hand")
        both = hand + MassProperties.of(1.0, np.zeros(3), ph.Inertia.spherical(0.1))
    assert both.inertia.tensor.dtype == both.centre.dtype == both.mass.dtype == np.float32


def test_a_scene_of_mass_properties_names_their_inertia(arm):
    with pytest.raises(TypeError, match=r"got MassProperties: pass its \.inertia"):
        ph.Scene(MassProperties.from_urdf(arm, "hand"))


def test_links_of_extensions_are_not_those_of_the_robot(arm):
    own = MassProperties.from_urdf(arm, "hand")
    inertial = (
        '<inertial><mass value="9"/><inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/>'
        "</inertial>"
    )
    for inside in (inertial, ""):
        extension = f'<gazebo><plugin><link name="hand">{inside}</link></plugin></gazebo></robot>'
        arm.write_text(URDF.replace("</robot>", extension))
        assert float(MassProperties.from_urdf(arm, "hand").mass) == float(own.mass)
    arm.write_text(URDF.replace("</robot>", f'<link name="hand">{inertial}</link></robot>'))
    with pytest.raises(ValueError, match="2 links 'hand'"):
        MassProperties.from_urdf(arm, "hand")
    arm.write_text('<?xml version="1.0" encoding="nowhere"?>' + URDF)
    with pytest.raises(ValueError, match="not XML"):
        MassProperties.from_urdf(arm, "hand")
