"""How far to trust odometry: a random walk along the way, whatever the rate at which it was logged.

The variances of a stretch grow with the distance driven, the angle turned and the time in motion; a robot that was told
to stand stands exactly.
"""

from dataclasses import dataclass, fields

import numpy as np

from coopslam.errors import require_between


@dataclass(frozen=True, slots=True)
class Walk:
    """Random walk of one coordinate; m or rad. The variances of what was driven, turned and waited for add up."""

    after_1_m: float
    after_1_rad: float
    after_1_s: float  # in motion

    def __post_init__(self):
        require_between(0.0, 1e3, **{entry.name: getattr(self, entry.name) for entry in fields(self)})

    def variance(self, distance_m, turned_rad, moving_s):
        """m^2 or rad^2 after what was done, all zero or more; arrays."""
        return self.after_1_m**2 * distance_m + self.after_1_rad**2 * turned_rad + self.after_1_s**2 * moving_s


@dataclass(frozen=True, slots=True)
class CommandNoise:
    """What a robot that was told to drive does otherwise. A robot with zero commands stands exactly.

    The values are those of the robots of MR.CLAM as they come, not calibrated: what dead reckoning over 1 to 50 s
    misses of the solved trajectory of data set 6.
    """

    forward: Walk = Walk(0.03, 0.055, 0.001)  # m
    sideways: Walk = Walk(0.005, 0.005, 0.0007)  # m
    heading: Walk = Walk(0.13, 0.115, 0.001)  # rad; over 50 s, where drift to one side shows
    unknown_sigma_m: float = 0.5  # of each axis, after 1 s in which nobody knows what the robot did
    unknown_heading_sigma_rad: float = 0.5  # after 1 s of the same

    def __post_init__(self):
        unknown = ("unknown_sigma_m", "unknown_heading_sigma_rad")
        require_between(0.0, 1e3, **{name: getattr(self, name) for name in unknown})

    def of_chords(self, length_m, turn_rad, moving_s):
        """Variances along and across, covariance of across and heading, variance of heading; axes of each chord.

        length_m, turn_rad: (N,) of arcs, with their signs.  The heading drifts along the way, so with its variance q
        at the end of length d: var(across) = q d^2 / 3 and cov(across, heading) = q d / 2.
        """
        driven = np.abs(length_m), np.abs(turn_rad), moving_s
        heading = self.heading.variance(*driven)
        across = self.sideways.variance(*driven) + heading * length_m**2 / 3
        return self.forward.variance(*driven), across, heading * length_m / 2, heading

    def of_arcs(self, length_m, turn_rad, moving_s) -> np.ndarray:
        """(N, 3, 3) covariances of arcs, each in the axes of its own end. Arguments as `of_chords`."""
        along, across, across_heading, heading = self.of_chords(length_m, turn_rad, moving_s)
        nothing = np.zeros(len(along))
        return turned(turn_rad / 2, along, nothing, across, nothing, across_heading, heading)


def turned(angle_rad, xx, xy, yy, xt, yt, tt) -> np.ndarray:
    """(N, 3, 3) covariances, given by their components, in axes that are turned by (N,) angles, counter-clockwise."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    cov = np.empty((len(c), 3, 3))
    cov[:, 0, 0] = c * c * xx + 2 * c * s * xy + s * s * yy
    cov[:, 0, 1] = cov[:, 1, 0] = c * s * (yy - xx) + (c * c - s * s) * xy
    cov[:, 1, 1] = s * s * xx - 2 * c * s * xy + c * c * yy
    cov[:, 0, 2] = cov[:, 2, 0] = c * xt + s * yt
    cov[:, 1, 2] = cov[:, 2, 1] = c * yt - s * xt
    cov[:, 2, 2] = tt
    return cov
