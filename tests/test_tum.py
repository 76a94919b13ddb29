import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopslam.errors import BadInput
from coopslam.io.tum import read_tum, write_tum
from coopslam.se2 import Pose2, xytheta


def some_poses(count=50):
    rng = np.random.default_rng(3)
    stamps = 1248272272.841 + np.sort(rng.uniform(0, 1000, count))
    return stamps, [Pose2(*rng.normal(size=2) * 100, rng.uniform(-math.pi, math.pi)) for _ in range(count)]


def test_columns_are_stamp_position_and_scipy_quaternion(tmp_path):
    stamps, poses = some_poses()
    write_tum(tmp_path / "a.tum", stamps, poses)
    table = np.loadtxt(tmp_path / "a.tum")
    assert table.shape == (50, 8)
    expected = np.array([xytheta(pose) for pose in poses])
    np.testing.assert_allclose(table[:, 0], stamps, rtol=0, atol=1e-9)
    np.testing.assert_allclose(table[:, 1:3], expected[:, :2], rtol=0, atol=1e-12)
    assert (table[:, 3] == 0).all()
    yaw = Rotation.from_quat(table[:, 4:]).as_euler("zyx")[:, 0]
    np.testing.assert_allclose(yaw, expected[:, 2], rtol=0, atol=1e-12)


def test_round_trip(tmp_path):
    stamps, poses = some_poses()
    poses += [Pose2(0, 0, math.pi), Pose2(0, 0, -3.0), Pose2()]
    stamps = np.append(stamps, [-1.5, 0.0, 0.0])  # any order, any sign
    write_tum(tmp_path / "a.tum", stamps, poses)
    stamps_again, poses_again = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(stamps_again, stamps)
    assert len(poses_again) == len(poses)
    assert all(pose.equals(again, 1e-12) for pose, again in zip(poses, poses_again, strict=True))


def test_no_poses(tmp_path):
    write_tum(tmp_path / "a.tum", [], [])
    stamps, poses = read_tum(tmp_path / "a.tum")
    assert stamps.shape == (0,) and poses == []


def test_misuse_is_refused(tmp_path):
    with pytest.raises(ValueError, match="shorter"):
        write_tum(tmp_path / "a.tum", [0.0, 1.0], [Pose2()])
    with pytest.raises(ValueError, match="not finite"):
        write_tum(tmp_path / "a.tum", [0.0], [Pose2(math.nan, 0, 0)])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1 2 3", "eight finite numbers"),
        ("1 2 3 0 0 0 0 one", "one"),
        ("1 nan 3 0 0 0 0 1", "eight finite numbers"),
        ("1 2 3 0 0 0 0 0.9", "unit quaternion"),
        ("1 2 3 0.5 0 0 0 1", "in the plane"),
        ("1 2 3 0 0.6 0 0 0.8", "in the plane"),
    ],
)
def test_bad_lines_are_named(tmp_path, line, expected):
    path = tmp_path / "a.tum"
    path.write_text(f"# a comment\n\n0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(BadInput, match=expected) as caught:
        read_tum(path)
    assert str(caught.value).startswith(f"{path}: line 4: ") and "\n" not in str(caught.value)


def test_files_that_are_not_text(tmp_path):
    (tmp_path / "a.tum").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadInput, match="not a text file"):
        read_tum(tmp_path / "a.tum")
    with pytest.raises(BadInput, match="cannot read"):
        read_tum(tmp_path / "none.tum")
