import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopslam.estimation.keys import describe, is_vertex, pose_key, vertex_key


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
    ],
)
def test_a_key_in_words(key, name):
    assert describe(key, ("robot0", "robot1")) == name
    assert is_vertex(key) == name.startswith("vertex")
