"""Odometry from velocity commands, each of which holds until the next: exact arcs, and how far to trust them.

A robot under constant velocities drives an arc of a circle. Arcs are composed, all at once, to steps that are short
enough for the sightings between them. The error is a random walk along the way, so it depends on what was driven and
not on how often it was logged.
"""

from dataclasses import dataclass, fields

import numpy as np

from coopslam.odometry_noise import CommandNoise, Walk, turned
from coopslam.records import Odometry
from coopslam.se2 import Pose2

__all__ = ["CommandNoise", "Walk", "odometry_of_commands"]

_INSTANT_S = 1e-6  # no step is shorter by choice
_LONGEST_UNKNOWN_S = 1e4  # beyond, not knowing where a robot went cannot get worse


@dataclass(frozen=True, slots=True, eq=False)
class _Spans:
    """Contiguous spans of time, N each, in which one command holds; s since the first command."""

    start_s: np.ndarray
    end_s: np.ndarray
    forward_m_per_s: np.ndarray
    turn_rad_per_s: np.ndarray
    unknown: np.ndarray  # bool; nobody knows what the robot did

    def __getitem__(self, index) -> "_Spans":
        return _Spans(*(getattr(self, entry.name)[index] for entry in fields(self)))

    @property
    def moving(self) -> np.ndarray:
        return ~self.unknown & ((self.forward_m_per_s != 0) | (self.turn_rad_per_s != 0))


def odometry_of_commands(
    robot: str, commands: np.ndarray, noise: CommandNoise, period_s: float, longest_gap_s: float, needed_s: np.ndarray
) -> tuple[list[Odometry], int]:
    """The robot's odometry, in order and without gaps, and the number of spans in which its motion is unknown.

    commands: (N, 3) time, forward velocity, angular velocity; s, m/s, rad/s; by ascending time.
    period_s: longest step in motion; a robot that stands gets one record for as long as it stands.
    longest_gap_s: where commands, or sightings before the first and after the last, are further apart, the motion
    in between is unknown: identity with a covariance of that size.
    needed_s: stamps at which the robot saw or was seen; unknown motion is cut there.
    """
    needed = np.unique(needed_s)
    if not len(commands):  # as after a command, so long ago that nobody knows what the robot does
        commands = np.array([[stamp_s, 0.0, 0.0] for stamp_s in needed[:1]]).reshape(-1, 3)
    if not len(commands):
        return [], 0
    origin_s = commands[0, 0]
    needed = needed - origin_s
    spans = _spans(commands, needed, origin_s, longest_gap_s)
    if not len(spans.start_s):
        return [], 0
    unknown = int(spans.unknown.sum())
    spans = _cut(_merged(spans), needed, period_s)
    first = _first_of_each_step(spans, period_s)
    x, y, heading, cov = _compose(spans, first, noise)
    starts = (origin_s + spans.start_s[first]).tolist()
    ends = [*starts[1:], float(origin_s + spans.end_s[-1])]
    steps = zip(starts, ends, x.tolist(), y.tolist(), heading.tolist(), cov, strict=True)
    return [Odometry(start, end, robot, Pose2(a, b, c), cov_now) for start, end, a, b, c, cov_now in steps], unknown


def _spans(commands: np.ndarray, needed: np.ndarray, origin_s: float, longest_gap_s: float) -> _Spans:
    """One span for each command that holds for some time, and for what precedes the first and follows the last."""
    stamps = commands[:, 0] - origin_s
    start, end, forward, turn = stamps[:-1], stamps[1:], commands[:-1, 1], commands[:-1, 2]
    before = needed[:1][needed[:1] < -longest_gap_s]
    after = needed[-1:][needed[-1:] > stamps[-1] + longest_gap_s]
    nothing_before, nothing_after = np.zeros(len(before)), np.zeros(len(after))
    start = np.concatenate([before, start, stamps[-1:][: len(after)]])
    end = np.concatenate([stamps[:1][: len(before)], end, after])
    forward = np.concatenate([nothing_before, forward, nothing_after])
    turn = np.concatenate([nothing_before, turn, nothing_after])
    return _Spans(start, end, forward, turn, end - start > longest_gap_s)[end > start]


def _merged(spans: _Spans) -> _Spans:
    """Neighbours with the same command as one."""
    same = np.ones(len(spans.start_s) - 1, dtype=bool)
    for column in (spans.forward_m_per_s, spans.turn_rad_per_s, spans.unknown):
        same &= column[1:] == column[:-1]
    first = np.insert(~same, 0, True)
    last = np.append(~same, True)
    merged = spans[first]
    return _Spans(merged.start_s, spans.end_s[last], merged.forward_m_per_s, merged.turn_rad_per_s, merged.unknown)


def _cut(spans: _Spans, needed: np.ndarray, period_s: float) -> _Spans:
    """Spans in motion cut at the multiples of the period, unknown ones at the instants that are needed."""
    first = np.floor(spans.start_s / period_s) + 1
    count = np.where(spans.moving, np.maximum(np.ceil(spans.end_s / period_s) - first, 0), 0).astype(int)
    parent = np.repeat(np.arange(len(count)), count)
    nth = np.arange(len(parent)) - np.repeat(np.cumsum(count) - count, count)
    grid = (first[parent] + nth) * period_s
    grid = grid[(grid > spans.start_s[parent] + _INSTANT_S) & (grid < spans.end_s[parent] - _INSTANT_S)]
    inside = needed[(needed > spans.start_s[0]) & (needed < spans.end_s[-1])]
    inside = inside[spans.unknown[np.searchsorted(spans.start_s, inside, side="right") - 1]]
    start = np.unique(np.concatenate([spans.start_s, grid, inside]))
    pieces = spans[np.searchsorted(spans.start_s, start, side="right") - 1]
    end = np.append(start[1:], spans.end_s[-1])
    return _Spans(start, end, pieces.forward_m_per_s, pieces.turn_rad_per_s, pieces.unknown)


def _first_of_each_step(spans: _Spans, period_s: float) -> np.ndarray:
    """Indices of the spans that begin a step: those in motion that share a period are one step."""
    period = np.floor((spans.start_s + spans.end_s) / 2 / period_s)
    goes_on = spans.moving[1:] & spans.moving[:-1] & (period[1:] == period[:-1])
    return np.flatnonzero(np.insert(~goes_on, 0, True))


def _compose(spans: _Spans, first: np.ndarray, noise: CommandNoise):
    """Per step: x, y, heading of its end in the frame of its start, and the (3, 3) covariance in the axes of its end.

    To first order, the error that a span adds reaches the end of the step through the lever between the two
    (Smith, Self and Cheeseman 1990). Written out by components for all spans at once.
    """
    step = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(spans.start_s))))
    duration = spans.end_s - spans.start_s
    known = ~spans.unknown
    length, turn = known * spans.forward_m_per_s * duration, known * spans.turn_rad_per_s * duration
    before = np.cumsum(turn) - turn
    before -= before[first][step]  # heading of the span's start in the frame of the step's start
    chord = length * np.sinc(turn / (2 * np.pi))  # numpy's sinc: sin(turn / 2) / (turn / 2)
    dx, dy = chord * np.cos(before + turn / 2), chord * np.sin(before + turn / 2)
    x, y, heading = (np.add.reduceat(part, first) for part in (dx, dy, turn))

    along, across, across_heading, var_heading = _noise_of_spans(spans, duration, length, turn, noise)
    c, s = np.cos(before + turn / 2), np.sin(before + turn / 2)
    xx, xy, yy = c * c * along + s * s * across, c * s * (along - across), s * s * along + c * c * across
    xt, yt = -s * across_heading, c * across_heading
    reached_x, reached_y = np.cumsum(dx), np.cumsum(dy)
    lever_x = (reached_x[first] - dx[first] + x)[step] - reached_x
    lever_y = (reached_y[first] - dy[first] + y)[step] - reached_y
    terms = (
        xx - 2 * lever_y * xt + lever_y**2 * var_heading,
        xy + lever_x * xt - lever_y * yt - lever_x * lever_y * var_heading,
        yy + 2 * lever_x * yt + lever_x**2 * var_heading,
        xt - lever_y * var_heading,
        yt + lever_x * var_heading,
        var_heading,
    )
    return x, y, heading, turned(heading, *(np.add.reduceat(term, first) for term in terms))


def _noise_of_spans(spans: _Spans, duration, length, turn, noise: CommandNoise):
    """As `CommandNoise.of_chords`; nobody knows where unknown motion leads, so it adds in all directions."""
    along, across, across_heading, heading = noise.of_chords(length, turn, spans.moving * duration)
    lost = spans.unknown * np.minimum(duration, _LONGEST_UNKNOWN_S)
    anywhere = noise.unknown_sigma_m**2 * lost
    return along + anywhere, across + anywhere, across_heading, heading + noise.unknown_heading_sigma_rad**2 * lost
