"""What there is to draw of a finished exploration: plain arrays in the frame of the estimate, metres."""

from dataclasses import dataclass, field

import networkx as nx
import numpy as np


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
    true_vertices: dict[int, np.ndarray] = field(default_factory=dict)  # map vertex id -> (2,)
