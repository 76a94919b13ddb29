"""Keys of the variables: poses `(robot, index)` and map vertices, and their names in words."""

import gtsam
import numpy as np

_INDEX_BITS = 32  # a key is a letter and 56 bits: 24 for the robot, 32 for the index of its pose


def pose_key(robot_index: int, index: int) -> int:
    """Key of a robot's pose number `index`."""
    return gtsam.symbol("x", robot_index << _INDEX_BITS | index)


def vertex_key(vertex: int) -> int:
    """Key of a map vertex (an oriented corner, a `Pose2`)."""
    return gtsam.symbol("v", vertex)


def landmark_key(number: int) -> int:
    """Key of a landmark of somebody's log (a point), by its place in the list of their names."""
    return gtsam.symbol("l", number)


def is_landmark(key: int) -> bool:
    """Whether the key is a landmark: a point, where all other variables are poses."""
    return gtsam.symbolChr(key) == ord("l")


def is_vertex(key: int) -> bool:
    """Whether the key is a map vertex."""
    return gtsam.symbolChr(key) == ord("v")


def value_of(values: gtsam.Values, key: int) -> "gtsam.Pose2 | np.ndarray":
    """The value of a variable: a pose, or (2,) when it is a landmark. Raises KeyError when there is none."""
    if not values.exists(key):
        raise KeyError(describe(key))
    return values.atPoint2(key) if is_landmark(key) else values.atPose2(key)


def robot_index(key: int) -> int | None:
    """Index of the robot whose pose it is; None for any other variable."""
    return gtsam.symbolIndex(key) >> _INDEX_BITS if gtsam.symbolChr(key) == ord("x") else None


def describe(key: int, robots=(), landmarks=()) -> str:
    """The key in words: "robot1 pose 17", "vertex 5", "landmark 7"; without names "robot #1 pose 17"."""
    letter, index = gtsam.symbolChr(key), gtsam.symbolIndex(key)
    if letter == ord("v"):
        return f"vertex {index}"
    if letter == ord("l"):
        return f"landmark {landmarks[index] if index < len(landmarks) else f'#{index}'}"
    robot_index = index >> _INDEX_BITS
    if letter != ord("x"):
        return f"variable {key}"
    robot = robots[robot_index] if robot_index < len(robots) else f"robot #{robot_index}"
    return f"{robot} pose {index & ((1 << _INDEX_BITS) - 1)}"
