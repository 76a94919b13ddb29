"""Place recognition as an exploration that resumes an old map asks for it."""

from collections.abc import Mapping
from dataclasses import dataclass

from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap
from coopslam.planning.corner_map import CornerMap, corner_map
from coopslam.planning.place_recognition import PlaceRecognition, PlaceSettings, Recognition, Verdict
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True, eq=False)
class Awake:
    """An answer in terms of vertices and of the frames of the two estimates."""

    reason: str
    vertices: Mapping[int, int] | None  # of the new map -> of the stored one; None: not recognized
    T_old_new: Pose2 | None
    recognition: Recognition


class WakingUp:
    """Asks where the team is; `answers` keeps what was said after each triangle."""

    def __init__(self, stored: CornerMap, robot: str, settings: PlaceSettings | None = None):
        """robot: in whose frame the small map is compared."""
        self._recognition, self._robot = PlaceRecognition(stored, settings), robot
        self.answers: list[tuple[int, Recognition]] = []  # (triangles, answer)
        self.last_map: CornerMap | None = None  # the small map of the last answer

    def __call__(self, free_map: FreeMap, estimate: Estimate) -> Awake:
        """Where a map lies that was explored since. The finder is the one of the stored map."""
        stored = self._recognition.stored
        small = corner_map(free_map, estimate, stored.angle_sigma_rad, self._robot)
        answer = self._recognition.recognize(small)
        self.last_map = small
        self.answers.append((len(free_map.triangles), answer))
        if answer.verdict is not Verdict.RECOGNIZED:
            return Awake(f"{answer.verdict}: {answer.reason}", None, None, answer)
        vertices = {small.ids[i]: stored.ids[j] for i, j in answer.pairs}
        T_old_robot = answer.belief.T_world_body
        T_old_new = T_old_robot * estimate.value(estimate.pose_key(self._robot)).inverse()
        return Awake(answer.reason, vertices, T_old_new, answer)
