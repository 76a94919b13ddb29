import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopslam.estimation.keys import describe, is_landmark, is_vertex, landmark_key, pose_key, value_of, vertex_key
from coopslam.se2 import Pose2


@given(st.lists(st.tuples(st.integers(0, 1000), st.integers(0, 2**32 - 1)), unique=True, min_size=2))
def test_different_poses_have_different_keys(pairs):
    assert len({pose_key(*pair) for pair in pairs}) == len(pairs)


@pytest.mark.parametrize(
    ("key", "name"),
    [
        (pose_key(1, 17), "robot1 pose 17"),
        (pose_key(0, 0), "robot0 pose 0"),
        (pose_key(2, 5), "robot #2 pose 5"),
        (vertex_key(5), "vertex 5"),
        (landmark_key(1), "landmark post"),
        (landmark_key(7), "landmark #7"),
    ],
)
def test_a_key_in_words(key, name):
    assert describe(key, ("robot0", "robot1"), ("tree", "post")) == name
    assert is_vertex(key) == name.startswith("vertex")
    assert is_landmark(key) == name.startswith("landmark")


def test_the_value_of_a_variable_is_a_pose_or_a_point():
    values = gtsam.Values()
    values.insert(pose_key(1, 0), Pose2(1, 2, 3))
    values.insert(vertex_key(4), Pose2(4, 5, 6))
    values.insert(landmark_key(0), np.array([7.0, 8.0]))
    assert value_of(values, pose_key(1, 0)).equals(Pose2(1, 2, 3), 0)
    assert value_of(values, vertex_key(4)).equals(Pose2(4, 5, 6), 0)
    np.testing.assert_array_equal(value_of(values, landmark_key(0)), [7.0, 8.0])
    for missing, name in ((pose_key(0, 3), "robot #0 pose 3"), (landmark_key(1), "landmark #1")):
        with pytest.raises(KeyError, match=name):
            value_of(values, missing)
