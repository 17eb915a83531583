"""The table of surveyed landmarks: columns by header, poses, covariances, and what is wrong in one line."""

import re

import numpy as np
import pytest
from places import ROOT
from rows import each

from graph_slam_ros.config.survey import surveyed
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.lie import se3, so3

RPY = (0.3, -0.2, 1.1)


def only(header, line, dimensions):
    (known,) = surveyed(f"{header}\n{line}\n", dimensions).values()
    return known


FULL = np.array([[4, 1, 0.5], [1, 5, 0.25], [0.5, 0.25, 6]])


@each(
    "header, values, full",
    [
        ("sigma", "0.1", 0.01 * np.eye(3)),
        ("sigma_x,sigma_y,sigma_z", "0.1,0.2,0.3", np.diag([0.01, 0.04, 0.09])),
        ("cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz", "4,1,0.5,5,0.25,6", FULL),
    ],
)
def test_a_sigma_for_all_axes_or_for_each_or_a_full_covariance(header, values, full):
    for n in (2, 3):
        known = only(f"id,x,y,z,{header}", f"a,1,2,3,{values}", n)
        assert (known.position, known.orientation) == ((1.0, 2.0, 3.0)[:n], ())
        assert np.array(known.position_covariance) == pytest.approx(full[:n, :n])


@each("dimensions", [2, 3])
def test_angles_and_a_quaternion_say_the_same(dimensions):
    q = se3.rotation(se3.from_xyz_rpy((0, 0, 0, *RPY)))
    by_angles = only(
        "id,x,y,z,sigma,roll,pitch,yaw,sigma_rad", f"a,1,2,3,0.1,{','.join(map(str, RPY))},0.2", dimensions
    )
    rounded = ",".join(f"{x:.2f}" for x in q)  # as a survey may be written
    by_quaternion = only("id,x,y,z,sigma,qx,qy,qz,qw,sigma_rad", f"a,1,2,3,0.1,{rounded},0.2", dimensions)
    assert by_quaternion.orientation == pytest.approx(by_angles.orientation, abs=0.02)
    assert by_quaternion.covariance == by_angles.covariance
    if dimensions == 3:
        assert np.linalg.norm(by_quaternion.orientation) == pytest.approx(1.0, abs=1e-12)
        assert by_angles.orientation == pytest.approx(q)
    else:
        assert by_angles.orientation == pytest.approx([RPY[2]])


@each("dimensions", [2, 3])
def test_a_sigma_for_each_angle_is_about_the_axes_of_map(dimensions):
    header = "id,x,y,z,sigma_x,sigma_y,sigma_z,roll,pitch,yaw,sigma_roll,sigma_pitch,sigma_yaw"
    known = only(header, "a,1,2,3,0.1,0.2,0.3,0,0,1,0.4,0.5,0.6", dimensions)
    sigmas = [0.1, 0.2, 0.6] if dimensions == 2 else [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    assert np.array(known.covariance) == pytest.approx(np.diag(np.square(sigmas)))
    assert known.pose == pytest.approx((1, 2, 1) if dimensions == 2 else (1, 2, 3, 0, 0, np.sin(0.5), np.cos(0.5)))


def test_some_landmarks_of_a_table_may_have_no_orientation():
    known = surveyed("id,x,y,sigma,yaw,sigma_rad\na,1,2,0.1,0.5,0.2\nb,3,4,0.1,,\n", 2)
    assert known["a"].orientation == (0.5,)
    assert known["b"] == only("id,x,y,sigma", "b,3,4,0.1", 2)
    assert only("id,x,y,cov_xx,cov_xy,cov_yy", "a,1,2,4,1,5", 2).position_covariance == ((4, 1), (1, 5))


def test_the_example_of_the_manual_is_a_tag_on_a_wall():
    (text,) = re.findall(r"```csv\n(.*?)```", (ROOT / "docs" / "inputs.md").read_text(), re.DOTALL)
    tag, other = surveyed(text, 3).values()
    assert so3.act(tag.orientation, (0.0, 0.0, 1.0)) == pytest.approx((0.0, 1.0, 0.0)), "its normal"
    assert so3.act(tag.orientation, (1.0, 0.0, 0.0)) == pytest.approx((-1.0, 0.0, 0.0)), (
        "to the right of who looks at it"
    )
    assert other.orientation == ()
    assert abs(surveyed(text, 2)["tag36h11:7"].orientation[0]) == pytest.approx(np.pi)


WRONG = """
2 | a,1,2,0.1 |  | line 1: column 'a' is not known: expected a header with some of id,x,y,z,sigma,
2 | id,x,y,sigma,X |  | line 1: column 'X' is not known
2 | id,x,y,x,sigma |  | line 1: column 'x' is given twice
2 | id,x,sigma |  | line 1: columns of a position: id,x, expected id,x,y or id,x,y,z
3 | id,x,y,sigma |  | line 1: columns of a position: id,x,y, expected id,x,y,z
2 | id,x,y |  | line 1: columns of the noise of the position: none, expected sigma or sigma_x,sigma_y or cov_xx,
2 | id,x,y,sigma,sigma_x |  | line 1: columns of the noise of the position: sigma,sigma_x, expected sigma or
2 | id,x,y,sigma,yaw |  | line 1: columns of the noise of the orientation: none, expected sigma_yaw or sigma_rad
2 | id,x,y,sigma,sigma_rad |  | line 1: columns of an orientation: none, expected yaw or roll,pitch,yaw or qx,qy,qz,qw
2 | id,x,y,sigma,yaw,qx,qy,qz,qw,sigma_rad |  | line 1: columns of an orientation: yaw,qx,qy,qz,qw, expected yaw or
3 | id,x,y,z,sigma,yaw,sigma_rad |  | line 1: columns of an orientation: yaw, expected roll,pitch,yaw or qx,qy,qz,qw
2 | id,x,y,sigma,yaw,sigma_rad | a,1,2,0.1,0.5 | line 2: 5 values, not id,x,y,sigma,yaw,sigma_rad
2 | id,x,y,sigma,yaw,sigma_rad | a,1,2,0.1,,0.5 | line 2: yaw '' is not a finite number
2 | id,x,y,sigma,yaw,sigma_rad | a,1,2,0.1,inf,0.5 | line 2: yaw 'inf' is not a finite number
2 | id,x,y,sigma,yaw,sigma_rad | a,1,2,0.1,0.5,0 | line 2: sigma_rad 0 is not above 0: nothing is certain
2 | id,x,y,sigma,yaw,sigma_rad | a,1,2,0.1,90,1 | line 2: yaw 90 is more than a turn: expected radians
2 | id,x,y,sigma,yaw,sigma_rad | a,1,2,0.1,1,10 | line 2: sigma_rad 10 is more than a turn: expected radians
2 | id,x,y,sigma_x,sigma_y | a,1,2,0.1,-1 | line 2: sigma_y -1 is not above 0: nothing is certain
2 | id,x,y,cov_xx,cov_xy,cov_yy | a,1,2,1,2,1 | line 2: cov_xx,cov_xy,cov_yy: [1 2; 2 1] is no positive
2 | id,x,y,sigma | a,1,2,1e200 | line 2: sigma: [inf 0; 0 inf] is no positive definite covariance
2 | id,x,y,sigma,qx,qy,qz,qw,sigma_rad | a,1,2,1,0,0,0,0,1 | line 2: qx,qy,qz,qw: a quaternion of length 0, expected 1
2 | id,x,y,sigma,roll,pitch,yaw,sigma_rad | a,1,2,1,0,1.57,0,1 | line 2: roll,pitch,yaw: the x axis of the landmark is
2 | id,x,y,sigma,yaw,sigma_rad | a,1,2,1,0,1\\na,1,2,1,0,1 | line 3: 'a' is given twice
"""


@each("row", WRONG.strip().splitlines())
def test_what_is_wrong_is_said_with_line_column_and_what_is_expected(row):
    dimensions, header, line, said = (one.strip() for one in row.split(" | "))
    text = line.replace("\\n", "\n")
    with pytest.raises(ConfigError) as caught:
        surveyed(f"{header}\n{text}\n", int(dimensions))
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)
