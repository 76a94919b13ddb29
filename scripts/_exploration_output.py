"""What a finished exploration leaves behind: its summary, the files of its run directory, and what its figures show."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

import networkx as nx
import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.estimation.estimate import Estimate, Trajectory
from coopslam.evaluation.exploration_score import (
    bound_on_ate,
    causal_ate_rmse_m,
    score_trajectories,
    score_triangulation,
    score_vertices,
)
from coopslam.evaluation.tracker_score import score_fixes
from coopslam.io.toml import to_mapping
from coopslam.io.tum import write_tum
from coopslam.planning.dual_graph import signed_area_m2
from coopslam.records import RelativePoseFix
from coopslam.report.pose_graph_file import write_pose_graph
from coopslam.report.run_directory import (
    write_dual_graph,
    write_json,
    write_map,
    write_trajectory,
)
from coopslam.report.run_view import RunView, UncertaintyPoint
from coopslam.report.story import story_of
from coopslam.se2 import position, rotation

if TYPE_CHECKING:
    from _exploration import Exploration, LeftOut


def summarize(run: Exploration) -> dict:
    """The figures of CONTRACT; everything but keys that end in _seconds is the same for the same settings."""
    mission, free_map, attempt = run.mission, run.mission.explorer.free_map, run.left_out.attempt
    summary = {
        "world": run.world.name,
        "seed": run.settings.seed,
        "noise": run.settings.noise_name,
        "estimator": run.settings.estimator,
        "robots": list(run.settings.team.robots),
        "strategy": run.settings.explorer.strategy,
        "false_sightings": to_mapping(run.settings.false_sightings),
        "outcome": mission.outcome,
        "outcome_reason": mission.reason,
        "vertices": len(free_map.fans),
        "holes": free_map.holes,
        "triangles": len(free_map.triangles),
        "moves": mission.moves,
        "role_exchanges": mission.role_exchanges,
        "travel_m": dict(mission.travel_m),
        "travel_over_perimeter": sum(mission.travel_m.values()) / run.world.perimeter_m,
        "mapped_area_m2": attempt("mapped_area_m2", _mapped_area_m2, run),
        **(attempt("scores of the triangulation", _triangulation, run) or {}),
        **(attempt("scores of the vertices", _vertices, run) or {}),
        "sightings": _sightings(run),
        "tracker": attempt("tracker", _tracker, run),
        "corners_misnamed": run.truth.misnamed,
        "smoothed_moved_m": attempt("smoothed_moved_m", lambda: _largest_move(mission.estimate, run.final)),
        "estimators": _estimators(run),
        "resumed": run.resumed or None,
    }
    return {key: _finite(key, value, run.left_out) for key, value in summary.items() if value is not None}


def _triangulation(run: Exploration) -> dict:
    """The scores of the triangulation; none at all is not a true one."""
    free_map = run.mission.explorer.free_map
    scores = score_triangulation(free_map, run.truth)
    return scores if free_map.triangles else {**scores, "true_triangulation": False}


def _vertices(run: Exploration) -> dict:
    """The scores of the vertices. Raises UnderDetermined when there is no triangle: two corners are no map."""
    if not run.mission.explorer.free_map.triangles:
        raise UnderDetermined("no triangle was found")
    return score_vertices(run.mission.explorer.free_map, run.final, run.truth)


def _sightings(run: Exploration) -> dict[str, int]:
    """How many sightings of robots by robots there were, and what became of those that looked false."""
    fixes = sum(isinstance(record, RelativePoseFix) for record in run.records)
    found = {"fixes": fixes, "refused": len(run.driver.timeline.refused)}
    if run.solution is not None:
        found |= {"thrown_out": run.solution.thrown_out, "taken_back": run.solution.taken_back}
    return found


def _tracker(run: Exploration) -> dict:
    """Which robot tracker, how often it looked and what it said, and how near to the truth that was.

    Pictures are more than looks: a bearing at which a robot is to stop is watched for in pictures of its own.
    """
    settings = run.settings
    kind = settings.tracker_preset if settings.tracker == "statistical" else settings.tracker
    return {"name": settings.tracker, "kind": kind, **run.looks, **score_fixes(run.records, run.truth.tracks)}


def _estimators(run: Exploration) -> dict[str, dict]:
    """The scores of each estimator that came to an estimate."""
    attempt, mission = run.left_out.attempt, run.mission
    bound = attempt("crlb_ratio", lambda: bound_on_ate(run.graph, run.final, run.truth))
    causal_of = {"dead-reckoning": run.dead_reckoning, run.settings.estimator: mission.estimate}
    estimates = dict(causal_of)
    if run.batch is not None:
        estimates["batch"] = run.batch
    estimators = {}
    for name, estimate in estimates.items():
        scores = estimate and attempt(f"estimators.{name}", score_trajectories, estimate, run.truth, bound)
        if scores:
            known = causal_of.get(name)
            causal = known and attempt(f"estimators.{name}.causal_ate_rmse_m", causal_ate_rmse_m, known, run.truth)
            estimators[name] = {**scores, "causal_ate_rmse_m": causal, "wall_seconds": run.seconds[name]}
    return estimators


def _finite(name: str, value, left_out: LeftOut):
    """The value, with None for each number that JSON cannot say."""
    if isinstance(value, dict):
        return {key: _finite(f"{name}.{key}", item, left_out) for key, item in value.items()}
    if isinstance(value, float) and not isfinite(value):
        left_out[name] = f"it is {value}"
        return None
    return value


def _mapped_area_m2(run: Exploration) -> float:
    """Area of the polygon: inverted slivers count as negative."""
    triangles = run.mission.explorer.free_map.triangles.values()
    return sum(signed_area_m2([position(run.final.vertex(v)) for v in triangle]) for triangle in triangles)


def _largest_move(causal: Estimate, final: Estimate) -> float:
    """How far the batch solve moved any map vertex away from where the driving estimator left it, m."""
    moves = [np.hypot(*(position(causal.vertex(v)) - position(final.vertex(v)))) for v in final.vertices]
    return float(max(moves, default=0.0))


def write_run(run: Exploration, out: Path) -> None:
    """Trajectories, map, dual graph, pose graph and truth."""
    free_map, attempt = run.mission.explorer.free_map, run.left_out.attempt
    for robot in run.settings.team.robots:
        attempt(
            f"trajectories/{robot}.tum",
            lambda robot=robot: write_trajectory(out / "trajectories", robot, run.final, run.mission.estimate),
        )
    attempt("map.geojson", lambda: write_map(out / "map.geojson", free_map, run.final))
    if run.dual_graph is not None:
        write_dual_graph(out / "dual_graph.json", run.dual_graph)
    attempt("pose_graph.g2o", lambda: write_pose_graph(out, run.graph, run.final))
    truth = out / "truth"
    truth.mkdir(exist_ok=True)
    write_json(truth / "world.geojson", run.world.to_geojson())
    write_json(truth / "vertices.json", {str(v): list(run.world.ring_index(c)) for v, c in run.truth.corner_of.items()})
    for robot, track in run.truth.tracks.items():
        write_tum(truth / f"{robot}.tum", track.stamps_s, track.poses)


def view_of(run: Exploration) -> RunView:
    """What the figures show, in the frame of the estimate."""
    free_map, mission = run.mission.explorer.free_map, run.mission
    origin = next(iter(run.truth.tracks.values())).poses[0]

    def path(trajectory: Trajectory) -> np.ndarray:
        return np.array([position(pose) for pose in trajectory.poses])

    def at_start(points: np.ndarray) -> np.ndarray:
        return np.array([origin.transformTo(point) for point in points])

    sources = {
        "dead-reckoning": lambda robot: run.dead_reckoning and run.dead_reckoning.trajectory(robot),
        "causal": lambda robot: mission.estimate and mission.estimate.causal_trajectory(robot),
        "smoothed": lambda robot: run.final.trajectory(robot),
    }
    paths, stamps_s = {kind: {} for kind in sources}, {kind: {} for kind in sources}
    path_covariances = {}
    for kind, trajectory_of in sources.items():
        for robot in run.settings.team.robots:
            trajectory = run.left_out.attempt(f"figures: {kind} path of {robot}", trajectory_of, robot)
            if trajectory is not None:
                paths[kind][robot], stamps_s[kind][robot] = path(trajectory), trajectory.stamps_s
                if kind == "smoothed":
                    path_covariances[robot] = _map_axes(trajectory)
    paths["true"] = {robot: at_start(path(track)) for robot, track in run.truth.tracks.items()}
    stamps_s["true"] = {robot: track.stamps_s for robot, track in run.truth.tracks.items()}
    covariances = run.left_out.attempt("figures: map", _vertex_covariances, run)
    mapped = covariances is not None
    return RunView(
        name=run.world.name,
        summary=run.summary,
        vertices={v: position(run.final.vertex(v)) for v in free_map.fans} if mapped else {},
        covariances=covariances or {},
        triangles=dict(free_map.triangles) if mapped else {},
        walls=free_map.walls() if mapped else [],
        gates=sorted(free_map.gates) if mapped else [],
        dual_graph=run.dual_graph if mapped and run.dual_graph is not None else nx.Graph(),
        paths=paths,
        history=[
            UncertaintyPoint(p.stamp_s, p.role_exchanges, p.travel_m, p.triangles, p.position_sigma_m)
            for p in mission.history
        ],
        true_rings=[at_start(ring) for ring in run.world.rings],
        slippery=[at_start(patch.ring) for patch in run.world.patches],
        true_vertices={v: at_start([position(run.truth.corners[c])])[0] for v, c in run.truth.corner_of.items()},
        story=story_of(run.records, run.settings.team.robots[:2]),
        stamps_s=stamps_s,
        path_covariances=path_covariances,
    )


def _map_axes(trajectory: Trajectory) -> np.ndarray:
    """(N, 2, 2) covariances of the positions, from the axes of each pose to those of the map."""
    turns = np.reshape([rotation(pose.theta()) for pose in trajectory.poses], (-1, 2, 2))
    return turns @ trajectory.covariances[:, :2, :2] @ turns.transpose(0, 2, 1)


def _vertex_covariances(run: Exploration) -> dict[int, np.ndarray]:
    """(2, 2) each, map axes."""
    return {v: run.final.vertex_belief(v).position_covariance for v in run.mission.explorer.free_map.fans}
