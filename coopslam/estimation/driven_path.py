"""One robot's odometry as a whole, dead-reckoned to any instants under any calibration: all in arrays."""

from collections.abc import Iterable

import numpy as np

from coopslam.estimation.calibration import PARAMETERS, calibrated_twists, poses_of, twists_of
from coopslam.records import Odometry, Record
from coopslam.se2 import wrap

_DELAY = PARAMETERS.index("delay_s")


class DrivenPath:
    """Where odometry says that a robot is, in the frame of its start; within a record it drives an arc."""

    def __init__(self, records: Iterable[Odometry]):
        """records: raw, of one robot; in time, the first of any that overlap counts."""
        kept, end_s = [], -np.inf
        for record in sorted(records, key=lambda record: record.start_s):
            if record.start_s >= end_s - 1e-6:
                kept.append(record)
                end_s = record.stamp_s
        self.start_s = np.array([record.start_s for record in kept])
        self.end_s = np.array([record.stamp_s for record in kept])
        self.twists = twists_of(kept)
        moved = self.twists.any(axis=1)
        # motion that nobody knows: no step, but a covariance
        self.unknown = ~moved & np.array([bool(np.any(record.cov_now)) for record in kept], dtype=bool)
        self._moving_s = np.where(moved, self.end_s - self.start_s, 0.0)

    def __len__(self) -> int:
        return len(self.start_s)

    def at(self, stamps_s: np.ndarray, constants: np.ndarray) -> np.ndarray:
        """(M, 3) x, y, heading (not wrapped) at (M,) stamps. constants: (9,) in the order of `PARAMETERS`."""
        twists = calibrated_twists(self.twists, constants)
        heading = np.concatenate([[0.0], np.cumsum(twists[:, 2])])
        steps = compose(np.column_stack([np.zeros((len(twists), 2)), heading[:-1]]), poses_of(twists))
        place = np.vstack([np.zeros((1, 2)), np.cumsum(steps[:, :2], axis=0)])
        record, share = self._within(stamps_s - constants[_DELAY])
        return compose(np.column_stack([place, heading])[record], poses_of(share[:, None] * twists[record]))

    def done(self, stamps_s: np.ndarray, constants: np.ndarray) -> np.ndarray:
        """(M, 5) until each stamp: net forward m, net turn rad, driven m, turned rad, s in motion; calibrated."""
        twists = calibrated_twists(self.twists, constants)
        steps = np.column_stack([twists[:, [0, 2]], np.abs(twists[:, [0, 2]]), self._moving_s])
        return self._summed(steps, stamps_s - constants[_DELAY])

    def lost_s(self, stamps_s: np.ndarray, constants: np.ndarray) -> np.ndarray:
        """(M,) seconds of unknown motion until each stamp, time without any odometry included."""
        covered = np.where(self.unknown, 0.0, self.end_s - self.start_s)
        own_s = stamps_s - constants[_DELAY]
        return own_s - self._summed(covered[:, None], own_s)[:, 0]

    def _summed(self, steps: np.ndarray, own_s: np.ndarray) -> np.ndarray:
        """(M, K) sums of what (N, K) records add, until stamps on odometry's own clock."""
        before = np.vstack([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
        record, share = self._within(own_s)
        return before[record] + share[:, None] * steps[record]

    def _within(self, own_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(M,) index of the last record that has begun, and which share of it is over, on odometry's own clock."""
        record = np.maximum(np.searchsorted(self.start_s, own_s, side="right") - 1, 0)
        duration = self.end_s[record] - self.start_s[record]
        since = own_s - self.start_s[record]
        share = np.divide(since, duration, out=np.where(since >= 0, 1.0, 0.0), where=duration > 0)
        return record, np.clip(share, 0.0, 1.0)


def driven_paths(records: Iterable[Record]) -> dict[str, DrivenPath]:
    """The path of each robot that has odometry."""
    by_robot: dict[str, list[Odometry]] = {}
    for record in records:
        if isinstance(record, Odometry):
            by_robot.setdefault(record.robot, []).append(record)
    return {robot: DrivenPath(own) for robot, own in by_robot.items()}


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 3) states of a * b for (N, 3) states of each; headings are added, not wrapped."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        [a[:, 0] + c * b[:, 0] - s * b[:, 1], a[:, 1] + s * b[:, 0] + c * b[:, 1], a[:, 2] + b[:, 2]]
    )


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 3) states of b in the frames of a, for (N, 3) states of each; headings are subtracted, not wrapped."""
    dx, dy = (b - a)[:, :2].T
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, b[:, 2] - a[:, 2]])


def interpolated(stamps_s: np.ndarray, states: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """(M, 3) states at other times, the nearest beyond the ends; the heading goes the shorter way round."""
    heading = np.unwrap(states[:, 2])
    columns = (states[:, 0], states[:, 1], heading)
    return np.column_stack([np.interp(at_s, stamps_s, column) for column in columns])


def residual_twists(measured: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(N, 3) errors of (N, 3) relative poses in the axes of their ends."""
    error = between(measured, true)
    error[:, 2] = wrap(error[:, 2])
    return error
