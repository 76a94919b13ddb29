"""Leap-frog logs in which the tracker returns reflections, or nothing, and odometry may be nearly absent."""

from dataclasses import replace

import numpy as np
from leapfrog import FIX_COV, ROBOTS, LeapFrog, leapfrog

from coopslam.records import Odometry, RelativePoseFix
from coopslam.se2 import Pose2, wrap, xytheta

STANDING = 6  # instants at which the robots look at each other before the first leg


class Sightings:
    """A leap-frog world whose robots watch each other, and which of its fixes are false."""

    def __init__(
        self,
        rng: np.random.Generator,
        legs: int,
        outliers: float = 0.0,
        dropouts: float = 0.0,
        odometry_factor: float = 1.0,
        standing: int = STANDING,
    ):
        """outliers, dropouts: shares of all fixes.  odometry_factor: of odometry's sigmas, true and believed alike."""
        world = leapfrog(rng, legs)
        self.truth, self.corners = world.truth, world.corners
        self.false: dict[int, RelativePoseFix] = {}  # by id, which is nobody else's while the record lives
        start = [fix for k in range(standing) for fix in self._mutual(-0.1 * (standing - k), rng)]
        self.clean = LeapFrog(
            [start, *([*self._watched(group, rng, odometry_factor)] for group in world.groups[1:])],
            world.truth,
            world.corners,
        )
        groups = [[*self._disturbed(group, rng, outliers, dropouts)] for group in self.clean.groups]
        self.world = LeapFrog(groups, world.truth, world.corners)

    def pose(self, robot: str, stamp_s: float) -> Pose2:
        """True pose at a sampled instant."""
        truth = self.truth[robot]
        return truth.poses[max(int(np.searchsorted(truth.stamps_s, stamp_s + 1e-9)) - 1, 0)]

    def is_false(self, record) -> bool:
        return id(record) in self.false

    def _mutual(self, stamp_s: float, rng):
        for observer, target in (ROBOTS, ROBOTS[::-1]):
            relative = self.pose(observer, stamp_s).between(self.pose(target, stamp_s))
            state = xytheta(relative) + rng.standard_normal(3) * np.sqrt(np.diag(FIX_COV))
            yield RelativePoseFix(stamp_s, observer, target, Pose2(*state), FIX_COV)

    def _watched(self, group, rng, odometry_factor: float):
        """Fixes in both directions; odometry drawn anew."""
        for record in group:
            if isinstance(record, RelativePoseFix):
                yield from self._mutual(record.stamp_s, rng)
            elif isinstance(record, Odometry) and odometry_factor != 1.0:
                delta = self.pose(record.robot, record.start_s).between(self.pose(record.robot, record.stamp_s))
                cov = record.cov_now * odometry_factor**2
                measured = delta * Pose2(*(rng.standard_normal(3) * np.sqrt(np.diag(cov))))
                yield replace(record, T_start_now=measured, cov_now=cov)
            else:
                yield record

    def _disturbed(self, group, rng, outliers: float, dropouts: float):
        for record in group:
            lucky, false = rng.random(2)
            if not isinstance(record, RelativePoseFix):
                yield record
            elif lucky >= dropouts:
                yield self.reflection(record, rng) if false < outliers else record

    def reflection(self, fix: RelativePoseFix, rng) -> RelativePoseFix:
        """Gross errors in range, bearing and heading, with the covariance of a good fix."""
        true = fix.T_observer_target
        while True:
            range_m, bearing, heading = rng.uniform([0.3, -np.pi, -np.pi], [8.0, np.pi, np.pi])
            seen = Pose2(range_m * np.cos(bearing), range_m * np.sin(bearing), heading)
            if true.range(seen.translation()) > 0.5 and abs(wrap(heading - true.theta())) > 0.2:
                break
        false = replace(fix, T_observer_target=seen)
        self.false[id(false)] = false
        return false
