"""How a simulated team starts, moves and samples."""

import re
from dataclasses import dataclass

import numpy as np

from coopslam.errors import BadInput, require_between, require_positive, shown

MOST_ROBOTS = 6
PACES = ("speed_m_per_s", "turn_rate_rad_per_s", "odometry_period_s", "sighting_period_s")


@dataclass(frozen=True, slots=True)
class TeamSettings:
    """How the robots start, move and sample. Raises BadInput for what cannot be."""

    robots: tuple[str, ...] = ("robot0", "robot1")  # 2 to 6; the first stands in the corner, the second walks first
    start_ring: int = 0
    start_corner: int = 0
    start_step_m: float = 0.3  # from robot to robot along the wall; at most half the wall for all of them
    speed_m_per_s: float = 0.5
    turn_rate_rad_per_s: float = 1.0
    odometry_period_s: float = 1.0
    sighting_period_s: float = 2.0
    sightings_per_leg: int = 8  # at most; long legs are watched less often
    passing_corners_per_leg: int = 2  # at most so many corners beside a straight drive are looked at
    confirmations: int = 5  # so many consecutive false sightings make the team believe that contact is lost
    finder_reach_m: float = 0.5
    tracker_blind_m: float = 0.02  # closer than this the tracker sees nothing
    clock_s: float = 0.0  # what the robots' clock shows at the start

    def __post_init__(self):
        require_positive(start_step_m=self.start_step_m)
        for name in PACES:
            require_between(1e-3, 1e4, **{name: getattr(self, name)})
        for name in ("finder_reach_m", "tracker_blind_m", "passing_corners_per_leg", "clock_s"):
            if not 0 <= getattr(self, name) < np.inf:
                raise BadInput(f"{name}: zero or more expected, got {getattr(self, name)}")
        for name in ("sightings_per_leg", "confirmations"):
            if not 1 <= getattr(self, name) < np.inf:
                raise BadInput(f"{name}: 1 or more expected, got {getattr(self, name)}")
        if not 2 <= len(self.robots) <= MOST_ROBOTS:
            raise BadInput(f"robots: 2 to {MOST_ROBOTS} names expected, got {len(self.robots)}")
        for name in self.robots:
            if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", name):
                raise BadInput(f"robots: names of up to 40 letters, digits, - and _ expected, got {shown(name)}")
        if len({name.lower() for name in self.robots}) < len(self.robots):  # they are names of files, too
            raise BadInput(f"robots: names that differ in more than case expected, got {', '.join(self.robots)}")
