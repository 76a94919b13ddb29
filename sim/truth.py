"""What is true of a simulated run: its own door, for evaluation and figures only."""

from bisect import bisect_right
from dataclasses import dataclass, field

from coopslam.se2 import Pose2
from sim.world import World


@dataclass(slots=True)
class TruthTrack:
    """A robot's true poses at its sampled instants, in the world's frame."""

    stamps_s: list[float] = field(default_factory=list)
    poses: list[Pose2] = field(default_factory=list)


class Truth:
    """The simulator's own door: the world, the robots' true paths, and which corner each sighting showed."""

    def __init__(self, world: World, robots: tuple[str, ...]):
        self.world = world
        self.tracks = {robot: TruthTrack() for robot in robots}
        self.sighted: dict[tuple[float, str], int] = {}  # (stamp, observer) -> flat index of the corner

    @property
    def origin(self) -> Pose2:
        """True start pose of the first robot in the world: the estimated frame."""
        return next(iter(self.tracks.values())).poses[0]

    def pose_at(self, robot: str, stamp_s: float) -> Pose2:
        """True pose at a sampled instant, or at the last one before it (the robot stood still since)."""
        track = self.tracks[robot]
        return track.poses[max(bisect_right(track.stamps_s, stamp_s + 1e-9) - 1, 0)]

    def note(self, robot: str, stamp_s: float, pose: Pose2) -> None:
        """Where a robot is at an instant; what was noted of it for the same instant is replaced."""
        track = self.tracks[robot]
        if track.stamps_s and track.stamps_s[-1] == stamp_s:
            track.stamps_s.pop()
            track.poses.pop()
        track.stamps_s.append(stamp_s)
        track.poses.append(pose)
