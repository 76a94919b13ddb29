import numpy as np
import pytest

from coopslam.estimation.frames import Frames
from coopslam.estimation.keys import landmark_key, pose_key, vertex_key
from coopslam.estimation.pose_variables import tracks_of
from coopslam.estimation.tracks import Edge
from coopslam.se2 import Pose2

ROBOTS = ("a", "b", "c")
COV = np.eye(3) * 1e-4
LANDMARKS = {"tree": 0, "post": 1}


def started_frames():
    """Three robots, each with one pose, at the origin of its own frame."""
    frames = Frames(tracks_of(ROBOTS), LANDMARKS)
    for index, robot in enumerate(ROBOTS):
        frames.tracks[robot].keys.append(pose_key(index, 0))
        frames.add_pose(robot, pose_key(index, 0), Pose2())
    return frames


def test_each_robot_begins_in_a_frame_of_its_own():
    frames = started_frames()
    assert [frames.of(robot) for robot in ROBOTS] == frames.all and len(set(frames.all)) == 3
    assert [frames.is_placed(robot) for robot in ROBOTS] == [True, False, False]
    values, poses = frames.hand_out()
    assert poses == list(values.keys()) == [pose_key(0, 0)]
    assert frames.hand_out()[1] == []
    assert not Frames(tracks_of(ROBOTS), LANDMARKS).is_placed("a")  # nothing is known of it yet


def test_what_is_joined_moves_as_a_whole():
    """By hand: c is 2 m ahead of b, b is 5 m to the left of a and looks back."""
    frames = started_frames()
    frames.place_vertex(4, vertex_key(4), frames.of("c"), Pose2(0.0, 1.0, 0.0))
    assert frames.place_landmark("tree", frames.of("c"), np.array([1.0, 1.0])) == []
    assert frames.join("b", "c", Edge(pose_key(1, 0), pose_key(2, 0), Pose2(2.0, 0.0, 0.0), COV)) == []
    assert frames.of("b") is frames.of("c") is frames.of(4) and len(frames.all) == 2
    np.testing.assert_allclose(frames.point("tree", frames.of("b")), [3.0, 1.0], atol=1e-12)
    assert not frames.is_placed("tree")
    T_a_b = Pose2(0.0, 5.0, np.pi)
    back = Edge(pose_key(2, 0), pose_key(0, 0), (T_a_b * Pose2(2.0, 0.0, 0.0)).inverse(), COV)
    assert set(frames.join("c", "a", back)) == {"b", "c", 4, "tree"}
    assert all(map(frames.is_placed, ("a", "b", "c", 4, "tree")))
    values, poses = frames.hand_out()
    assert values.atPose2(pose_key(2, 0)).equals(Pose2(-2.0, 5.0, np.pi), 1e-12)
    assert values.atPose2(vertex_key(4)).equals(Pose2(-2.0, 4.0, np.pi), 1e-12)
    np.testing.assert_allclose(values.atPoint2(landmark_key(0)), [-3.0, 4.0], atol=1e-12)
    assert sorted(poses) == [pose_key(0, 0), pose_key(1, 0), pose_key(2, 0)]


def test_a_landmark_that_both_frames_know_keeps_its_place_in_the_one_that_stays():
    frames = started_frames()
    assert frames.place_landmark("tree", frames.anchored, np.array([1.0, 0.0])) == ["tree"]
    frames.hand_out()
    frames.estimate = {landmark_key(0): np.array([1.1, 0.0])}.get  # smoothed meanwhile
    frames.place_landmark("tree", frames.of("b"), np.array([9.0, 9.0]))
    frames.place_landmark("post", frames.of("b"), np.array([2.0, 0.0]))
    assert set(frames.merge(frames.anchored, frames.of("b"), Pose2(0.0, 1.0, 0.0))) == {"b", "post"}
    np.testing.assert_array_equal(frames.point("tree", frames.anchored), [1.1, 0.0])
    np.testing.assert_allclose(frames.point("post", frames.anchored), [2.0, 1.0])
    assert set(frames.hand_out()[0].keys()) == {pose_key(1, 0), landmark_key(1)}


@pytest.mark.parametrize(("doubt_a", "doubt_b", "better"), [(0.0, 1.0, "b"), (1.0, 0.0, "a"), (1e-4, 2e-4, None)])
def test_a_fix_corrects_the_guess_that_odometry_made_worse(doubt_a, doubt_b, better):
    frames, T_a_b = started_frames(), Pose2(1.0, 2.0, 0.5)
    keys = pose_key(0, 1), pose_key(0, 2)
    for key in keys:
        frames.add_pose("a", key, Pose2(8.0, 0.0, 0.0))
    frames.doubt = dict(zip(keys, (doubt_a, doubt_b), strict=True))
    frames.improve(Edge(*keys, T_a_b, COV), frames.anchored)
    expected = {
        "b": (Pose2(8, 0, 0), Pose2(8, 0, 0) * T_a_b),
        "a": (Pose2(8, 0, 0) * T_a_b.inverse(), Pose2(8, 0, 0)),
        None: (Pose2(8, 0, 0), Pose2(8, 0, 0)),
    }[better]
    assert all(frames.guess(key, frames.anchored).equals(pose, 1e-12) for key, pose in zip(keys, expected, strict=True))
    doubt = np.trace(COV) + min(doubt_a, doubt_b)
    if better:
        assert frames.doubt[keys["ab".index(better)]] == pytest.approx(doubt)
