"""What a filter knows: the mean and the covariance of robots' latest poses, map vertices and landmarks.

Inside, errors are differences in the axes of the frame: (x, y, heading) of a pose, (x, y) of a point. Turned by the
heading they are the right perturbations of `se2`, `T_true * Pose2(error)`; GTSAM moves by `T * Pose2.Expmap(error)`,
the same to first order, all that a covariance tells. Covariances go in and out in the axes of the poses.

A heading error turns what is around the origin as well, and nothing that robots measure of each other and of the map
tells how all of it together is turned. A filter that linearizes each time where its mean has moved to comes to believe
that it knows (Huang, Mourikis and Roumeliotis 2010, Observability-based rules for designing consistent EKF SLAM
estimators). So wherever the mean moves, by odometry or by a correction, the part of an error that comes from the
heading keeps its lever from the origin: the error is invariant (Barrau and Bonnabel 2015, An EKF-SLAM algorithm with
consistency properties), and a turn of everything stays as uncertain as it was. The heading that goes with a point is
that of the robot that placed it; a surveyed point has none.
"""

from collections.abc import Sequence

import numpy as np

from coopslam.se2 import Pose2, planar_rotation

_ROOM = 64  # rows at first
_LEVER_TOLERANCE_M = 1e-4  # levers follow the mean when it has moved so far: 1e-4 m times a heading error is nothing


class FilterState:
    """Mean and joint covariance of a growing number of variables, in arrays that double when they are full."""

    def __init__(self):
        self.size = 0  # rows in use
        self._places: dict[int, slice] = {}
        self._mean = np.zeros(_ROOM)
        self._cov = np.zeros((_ROOM, _ROOM))
        self._moved = np.zeros(_ROOM)  # by corrections, since the levers last followed
        self._heading = np.arange(_ROOM)  # row of the heading whose error moves this row; of a heading itself
        self._other = np.arange(_ROOM)  # x -> row of y, y -> row of x
        self._sign = np.zeros(_ROOM)  # of the lever: x -> -1, y -> 1; a heading has none

    def __contains__(self, key: int) -> bool:
        return key in self._places

    def keys(self) -> list[int]:
        """Of all variables."""
        return list(self._places)

    def place(self, key: int) -> slice:
        """Rows of a variable."""
        return self._places[key]

    def mean(self, key: int) -> np.ndarray:
        """(3,) x, y, heading, or (2,) x, y; a view."""
        return self._mean[self._places[key]]

    @property
    def cov(self) -> np.ndarray:
        """(size, size) joint covariance in the axes of the frame; a view."""
        return self._cov[: self.size, : self.size]

    def pose(self, key: int) -> Pose2:
        """The mean of a pose."""
        return Pose2(*self.mean(key))

    def block(self, key: int) -> np.ndarray:
        """(d, d) covariance of a variable in the axes of the frame; a view."""
        place = self._places[key]
        return self._cov[place, place]

    def covariance(self, key: int) -> np.ndarray:
        """(3, 3) in the axes of the pose; (2, 2) of a point in those of the frame."""
        return in_own_axes(self.mean(key), self.block(key))

    def joint(self, keys: Sequence[int]) -> np.ndarray:
        """Joint covariance, blocks in the order asked, each in the axes that `covariance` has."""
        rows = np.concatenate([np.arange(self._places[key].start, self._places[key].stop) for key in keys])
        turn = np.zeros((len(rows), len(rows)))
        start = 0
        for key in keys:
            own = _to_own_axes(self.mean(key))
            turn[start : start + len(own), start : start + len(own)] = own
            start += len(own)
        return turn @ self._cov[np.ix_(rows, rows)] @ turn.T

    # ---- variables come and go ----

    def add(self, key: int, mean: np.ndarray, cov: np.ndarray) -> None:
        """A variable that has nothing in common with the others; its covariance in the axes of the frame."""
        place = self._make_room(key, len(mean))
        self._mean[place], self._cov[place, place] = mean, cov

    def add_poses(self, keys: Sequence[int], base: int | None, T_base_new: Sequence[Pose2], cov: np.ndarray) -> None:
        """Poses that hang on one of the state, or on the frame itself (None), by measured relative poses.

        cov: joint covariance (3 N, 3 N) of the relative poses, each in the axes of its new pose.
        """
        T_frame_base = Pose2() if base is None else self.pose(base)
        states = [_state(T_frame_base * T) for T in T_base_new]
        turn = np.zeros_like(cov)
        for i, state in enumerate(states):
            turn[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = planar_rotation(state[2])
        cov = turn @ cov @ turn.T
        if base is None:
            self._augment(keys, states, np.zeros((len(cov), 0)), slice(0, 0), cov)
        else:
            carry = np.vstack([_carry(state - self.mean(base)) for state in states])
            self._augment(keys, states, carry, self._places[base], cov)

    def add_point(self, key: int, base: int, point: np.ndarray, cov: np.ndarray) -> None:
        """A point that hangs on a pose of the state. point: (2,), cov: (2, 2), both in the axes of that pose."""
        x, y, heading = self.mean(base).tolist()
        turn = planar_rotation(heading)[:2, :2]
        arm = turn @ point
        carry = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
        self._augment([key], [arm + (x, y)], carry, self._places[base], turn @ cov @ turn.T)
        place = self._places[key]
        self._heading[place] = self._places[base].start + 2
        self._sign[place] = -1.0, 1.0

    def drive(self, key: int, key_now: int, T_start_now: Pose2, cov_now: np.ndarray) -> None:
        """A pose gives its place to the next one of its robot. cov_now: (3, 3) in the axes of the new pose.

        In the axes of the poses the old errors go over with the adjoint of the way driven; in those of the frame the
        heading error gets the way for a lever.
        """
        place = self._places.pop(key)
        self._places[key_now] = place
        before = self._mean[place].copy()
        state = _state(Pose2(*before) * T_start_now)
        self._mean[place] = state
        cov, first = self.cov, place.start
        dx, dy = (state - before)[:2].tolist()
        of_heading = cov[first + 2].copy()
        cov[first] -= dy * of_heading
        cov[first + 1] += dx * of_heading
        with_heading = cov[:, first + 2].copy()
        cov[:, first] -= dy * with_heading
        cov[:, first + 1] += dx * with_heading
        turn = planar_rotation(state[2])
        own = cov[place, place] + turn @ cov_now @ turn.T
        cov[place, place] = (own + own.T) / 2

    def clone(self, key: int, key_clone: int, instead_of: int | None = None) -> None:
        """A copy of a pose, fully correlated with it: one stays and the other drives on (Roumeliotis and Burdick 2002,
        Stochastic cloning). instead_of: a pose that leaves the state and gives its place."""
        source = self._places[key]
        if instead_of is None:
            place = self._make_room(key_clone, 3)
        else:
            place = self._places[key_clone] = self._places.pop(instead_of)
        cov = self.cov
        self._mean[place], self._moved[place] = self._mean[source], self._moved[source]
        cov[place] = cov[source]
        cov[:, place] = cov[:, source]

    def forget_correlations(self, key: int) -> None:
        """Leave nothing that a variable has in common with the others."""
        place = self._places[key]
        own = self._cov[place, place].copy()
        self.cov[place], self.cov[:, place] = 0.0, 0.0
        self._cov[place, place] = own

    # ---- a measurement ----

    def spread(self, rows: Sequence[slice], jacobians: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """P H' (n, m) and H P H' (m, m) of a measurement.

        rows: of the variables measured.  jacobians: (m, d) each, in the axes of the frame.
        """
        cov = self.cov
        across = sum(cov[:, place] @ H.T for place, H in zip(rows, jacobians, strict=True))
        return across, sum(H @ across[place] for place, H in zip(rows, jacobians, strict=True))

    def correct(self, across: np.ndarray, S: np.ndarray, S_inverse: np.ndarray, miss: np.ndarray) -> None:
        """Kalman update with an innovation (m,) and its covariance S.  across: P H' as `spread` gives it.

        The covariance is Joseph's (I - K H) P (I - K H)' + K R K', multiplied out and put as P - K V' - V K' with
        V = P H' - K S / 2. Like Joseph's it is indifferent to errors of the gain to first order, which P - K H P is
        not; it subtracts a matrix and its own transpose, so that rounding leaves it symmetric; and it takes one product
        of (n, m) with (m, n) where Joseph's takes three. Doubles keep it positive for sigmas up to about 10^7 apart.
        """
        gain = across @ S_inverse
        step = gain @ miss
        self._mean[: self.size] += step
        self._moved[: self.size] += step
        change = gain @ (across - 0.5 * (gain @ S)).T
        cov = self.cov
        cov -= change + change.T
        self._follow_levers()

    def fuse(self, place: slice, gain: np.ndarray, miss: np.ndarray, cov: np.ndarray) -> None:
        """One variable alone: its mean moves by gain @ miss, its covariance becomes cov, in the axes of the frame."""
        self._mean[place] += gain @ miss
        self._cov[place, place] = (cov + cov.T) / 2

    def _follow_levers(self) -> None:
        """Carry heading errors to where the mean has moved, as `drive` does."""
        lever = self._sign[: self.size] * self._moved[self._other[: self.size]]
        rows = np.flatnonzero(np.abs(lever) >= _LEVER_TOLERANCE_M)
        if not len(rows):
            return
        cov, heading, lever = self.cov, self._heading[rows], lever[rows]
        among = np.ix_(rows, rows)
        change = lever[:, None] * cov[heading]
        both = change[:, rows] + change[:, rows].T + np.outer(lever, lever) * cov[np.ix_(heading, heading)]
        both += cov[among]
        cov[rows] += change
        cov[:, rows] += change.T
        cov[among] = both
        self._moved[self._other[rows]] = 0.0

    # ---- arrays ----

    def _augment(
        self, keys: Sequence[int], means: Sequence[np.ndarray], carry: np.ndarray, base: slice, cov: np.ndarray
    ) -> None:
        """New variables whose errors are carry @ (error of the base) + something of their own with covariance cov."""
        old = self.size
        for key, mean in zip(keys, means, strict=True):
            place = self._make_room(key, len(mean))  # first: it may bring new arrays
            self._mean[place] = mean
        new = slice(old, self.size)
        across = carry @ self._cov[base, :old]
        own = across[:, base] @ carry.T + cov
        self._cov[new, :old], self._cov[:old, new] = across, across.T
        self._cov[new, new] = (own + own.T) / 2

    def _make_room(self, key: int, dim: int) -> slice:
        place = slice(self.size, self.size + dim)
        if place.stop > len(self._mean):
            self._double()
        self._places[key] = place
        self.size, x = place.stop, place.start
        self._other[x : x + 2] = x + 1, x
        if dim == 3:
            self._heading[place] = x + 2
            self._sign[x : x + 2] = -1.0, 1.0
        return place

    def _double(self) -> None:
        room, cov = len(self._mean), self._cov
        self._cov = np.zeros((2 * room, 2 * room))
        self._cov[:room, :room] = cov
        self._mean, self._moved, self._sign = (
            np.append(a, np.zeros(room)) for a in (self._mean, self._moved, self._sign)
        )
        rows = np.arange(room, 2 * room)
        self._heading, self._other = np.append(self._heading, rows), np.append(self._other, rows)


def in_own_axes(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """A covariance in the axes of the frame, turned to those of the pose; that of a point stays."""
    turn = _to_own_axes(mean)
    return turn @ cov @ turn.T


def in_frame_axes(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """A covariance in the axes of a pose, turned to those of the frame."""
    turn = _to_own_axes(mean).T
    return turn @ cov @ turn.T


def _to_own_axes(mean: np.ndarray) -> np.ndarray:
    return planar_rotation(-mean[2]) if len(mean) == 3 else np.eye(2)


def _state(pose: Pose2) -> np.ndarray:
    return np.array([pose.x(), pose.y(), pose.theta()])


def _carry(arm: np.ndarray) -> np.ndarray:
    """(3, 3) what an error of a pose does to one that is fixed to it, arm away in the axes of the frame."""
    return np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
