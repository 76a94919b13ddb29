"""What there is to draw of a finished exploration: plain arrays in the frame of the estimate, metres."""

from dataclasses import dataclass, field

import networkx as nx
import numpy as np

from coopslam.report.story import Story


@dataclass(frozen=True, slots=True, eq=False)
class UncertaintyPoint:
    """How well the team knew where it was after one move."""

    stamp_s: float
    role_exchanges: int
    travel_m: float
    triangles: int
    position_sigma_m: dict[str, float]  # by robot


@dataclass(frozen=True, slots=True, eq=False)
class RunView:
    """One run. Everything from the truth is None or empty when there is none."""

    name: str
    summary: dict
    vertices: dict[int, np.ndarray]  # id -> (2,)
    covariances: dict[int, np.ndarray]  # id -> (2, 2), map axes, m^2
    triangles: dict[int, tuple[int, int, int]]
    walls: list[tuple[int, int]]
    gates: list[tuple[int, int]]  # still open
    dual_graph: nx.Graph  # node: centroid [x, y], area_m2, position_sigma_m ...; edge: gate, width_m ...
    paths: dict[str, dict[str, np.ndarray]]  # "dead-reckoning" | "causal" | "smoothed" | "true" -> robot -> (N, 2)
    history: list[UncertaintyPoint]
    true_rings: list[np.ndarray] = field(default_factory=list)  # (n_i, 2) each, ring 0 the outer boundary
    slippery: list[np.ndarray] = field(default_factory=list)  # (n_i, 2) each: outlines of slippery ground
    true_vertices: dict[int, np.ndarray] = field(default_factory=dict)  # map vertex id -> (2,)
    story: Story = field(default_factory=lambda: Story((), (), (), {}))
    stamps_s: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)  # of the paths: kind -> robot -> (N,)
    path_covariances: dict[str, np.ndarray] = field(default_factory=dict)  # smoothed: robot -> (N, 2, 2), map axes

    @property
    def robots(self) -> list[str]:
        """All robots that have a path."""
        return list(dict.fromkeys(robot for paths in self.paths.values() for robot in paths))

    def track(self, kind: str, robot: str) -> "Track | None":
        """The path of a robot by time; None when there is none of that kind."""
        path, stamps_s = self.paths.get(kind, {}).get(robot), self.stamps_s.get(kind, {}).get(robot)
        if path is None or stamps_s is None or not len(path):
            return None
        starts_s = [move.start_s for move in self.story.moves if move.robot == robot]
        return Track.with_departures(np.asarray(stamps_s, float), np.asarray(path, float), starts_s)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A path by time. In between, a robot drives straight and evenly; before and after, it stands."""

    stamps_s: np.ndarray  # (N,), increasing
    points: np.ndarray  # (N, 2)

    @classmethod
    def with_departures(cls, stamps_s: np.ndarray, points: np.ndarray, starts_s: list[float]) -> "Track":
        """starts_s: when moves began. Paths have a point where a robot arrives, none when it leaves again."""
        starts_s = np.asarray(starts_s, float)
        stood = points[np.maximum(np.searchsorted(stamps_s, starts_s, side="right") - 1, 0)]
        all_s = np.concatenate([stamps_s, starts_s])
        order = np.argsort(all_s, kind="stable")
        return cls(all_s[order], np.concatenate([points, np.reshape(stood, (-1, 2))])[order])

    def at(self, time_s: float) -> np.ndarray:
        """(2,) where the robot is at a moment."""
        return np.array([np.interp(time_s, self.stamps_s, values) for values in self.points.T])

    def between(self, start_s: float, end_s: float) -> np.ndarray:
        """(M, 2) the way driven between two moments."""
        inside = (self.stamps_s > start_s) & (self.stamps_s < end_s)
        return np.vstack([self.at(start_s), self.points[inside], self.at(end_s)])
