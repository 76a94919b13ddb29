"""Build a simulated exploration from settings, run it, and write everything that is to be known of it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import networkx as nx
import numpy as np

from coopslam import __version__
from coopslam.estimation.batch import Batch, BatchEstimate, solve_batch
from coopslam.estimation.dead_reckoning import DeadReckoning
from coopslam.estimation.estimate import Estimate, Trajectory
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.evaluation.exploration_score import (
    ExplorationTruth,
    bound_on_ate,
    causal_ate_rmse_m,
    score_map,
    score_trajectories,
)
from coopslam.exploration.explorer import Explorer, ExplorerSettings
from coopslam.exploration.mission import Budget, Mission, Progress, run_mission
from coopslam.io.run_log import RunLogWriter
from coopslam.io.toml import dump_toml, to_mapping
from coopslam.io.tum import write_tum
from coopslam.planning.dual_graph import dual_graph
from coopslam.planning.recorded_odometry import RecordedOdometry
from coopslam.records import CornerDecision, LogHeader, MoveNote, Record
from coopslam.report import figures, html
from coopslam.report.run_directory import (
    write_dual_graph,
    write_json,
    write_map,
    write_pose_graph,
    write_trajectories,
)
from coopslam.report.run_view import RunView, UncertaintyPoint
from coopslam.se2 import Pose2, position
from sim.noise import PRESETS, Noise
from sim.sensors import Sensors
from sim.team import Team, TeamSettings, Truth
from sim.world import World, load_world

DRIVERS = {"incremental": Incremental, "batch": Batch}


@dataclass(frozen=True, slots=True)
class ExplorationSettings:
    """Every setting of a simulated exploration; the keys of a config file."""

    world: str = "paper_one_obstacle"
    seed: int = 0
    noise: Literal["none", "typical", "legged"] = "typical"
    estimator: Literal["incremental", "batch"] = "incremental"
    figures: Literal["none", "static", "all"] = "static"
    true_noise: Noise | None = None  # instead of the preset's
    believed_noise: Noise | None = None
    team: TeamSettings = field(default_factory=TeamSettings)
    explorer: ExplorerSettings = field(default_factory=ExplorerSettings)
    incremental: IncrementalSettings = field(default_factory=IncrementalSettings)
    budget: Budget = field(default_factory=Budget)

    def resolved(self) -> "ExplorationSettings":
        """The same with the noise spelled out."""
        true, believed = PRESETS[self.noise]
        return replace(self, true_noise=self.true_noise or true, believed_noise=self.believed_noise or believed)


@dataclass(slots=True)
class Exploration:
    """A finished run: what drove, what smoothed, and what was true."""

    settings: ExplorationSettings
    world: World
    mission: Mission
    driver: Incremental | Batch
    final: Estimate
    dead_reckoning: Estimate
    truth: ExplorationTruth
    dual_graph: nx.Graph
    summary: dict


def explore(settings: ExplorationSettings, out: Path, watch: Callable[[Progress], None] | None = None) -> Exploration:
    """Explore, smooth, evaluate; the run directory `out` exists and gets everything but the figures."""
    began = time.perf_counter()
    settings = settings.resolved()
    world = load_world(settings.world)
    sensors = Sensors(settings.true_noise, settings.believed_noise, np.random.default_rng(settings.seed))
    team = Team(world, sensors, settings.team)
    robots = settings.team.robots
    driver = Incremental(robots, settings.incremental) if settings.estimator == "incremental" else Batch(robots)
    explorer = Explorer(robots, settings.explorer)
    (out / "config.toml").write_text(dump_toml(to_mapping(settings)), encoding="utf-8")

    records: list[Record] = []
    with RunLogWriter(out / "log.mcap", _header(settings, world)) as log:

        def keep(record: Record) -> None:
            records.append(record)
            log.append(record)
            if isinstance(record, MoveNote):
                log.flush()  # what a move brought is safe before the next

        mission = run_mission(team, driver, explorer, keep, settings.budget, watch)

    smoothing = time.perf_counter()
    values = solve_batch(driver.graph, driver.values(), robots)
    seconds = {"batch": time.perf_counter() - smoothing}
    final = BatchEstimate(driver.timeline, driver.graph, values)
    reckoner = DeadReckoning(robots)
    reckoned = reckoner.update(records)
    seconds |= {"dead-reckoning": reckoner.timing, settings.estimator: driver.timing}

    truth = _truth(team.truth, world, records)
    graph = dual_graph(explorer.free_map, final, RecordedOdometry(driver.graph, final))
    run = Exploration(settings, world, mission, driver, final, reckoned, truth, graph, {})
    run.summary = _summary(run, seconds)
    _write(run, out)
    run.summary["total_seconds"] = time.perf_counter() - began
    write_json(out / "summary.json", run.summary)
    return run


def draw(run: Exploration, out: Path) -> None:
    """figures/ and report.html of a run, which both go into its directory."""
    view = _view(run)
    drawn = [] if run.settings.figures == "none" else figures.draw_all(view, out / "figures")
    html.write_report(out / "report.html", view, drawn)


def _header(settings: ExplorationSettings, world: World) -> LogHeader:
    models = {"believed_noise": to_mapping(settings.believed_noise)}
    provenance = f"simulated by coopslam {__version__}"
    return LogHeader(
        settings.team.robots, seed=settings.seed, world=world.name, sensor_models=models, provenance=provenance
    )


def _truth(truth: Truth, world: World, records: list[Record]) -> ExplorationTruth:
    """The simulator's truth in the words of the evaluation."""
    corner_of, misnamed = {}, 0
    for record in records:
        if isinstance(record, CornerDecision):
            corner = truth.sighted[record.sighting.stamp_s, record.sighting.observer]
            misnamed += corner_of.setdefault(record.vertex, corner) != corner
    leaving = world.points[world.next_index] - world.points
    corners = [
        Pose2(*point, angle)
        for point, angle in zip(world.points, np.arctan2(leaving[:, 1], leaving[:, 0]), strict=True)
    ]
    tracks = {robot: Trajectory(np.array(track.stamps_s), track.poses) for robot, track in truth.tracks.items()}
    return ExplorationTruth(corners, world.polygon, world.triangles_expected, tracks, corner_of, misnamed)


def _summary(run: Exploration, seconds: dict[str, float]) -> dict:
    """The figures of CONTRACT; everything but keys that end in _seconds is the same for the same settings."""
    mission, free_map, driver = run.mission, run.mission.explorer.free_map, run.driver
    bound = bound_on_ate(driver.graph, run.final, run.truth)
    estimates = {"dead-reckoning": run.dead_reckoning, run.settings.estimator: mission.estimate, "batch": run.final}
    estimators = {}
    for name, estimate in estimates.items():
        scores = score_trajectories(estimate, run.truth, bound)
        causal = None if estimate is run.final else causal_ate_rmse_m(estimate, run.truth)
        estimators[name] = {**scores, "causal_ate_rmse_m": causal, "wall_seconds": seconds[name]}
    if run.settings.estimator == "batch":
        estimators["batch"]["causal_ate_rmse_m"] = causal_ate_rmse_m(mission.estimate, run.truth)
    scores = score_map(free_map, run.final, run.truth)
    return {
        "world": run.world.name,
        "seed": run.settings.seed,
        "noise": run.settings.noise,
        "estimator": run.settings.estimator,
        "outcome": mission.outcome,
        "outcome_reason": mission.reason,
        "vertices": len(free_map.fans),
        "holes": free_map.holes,
        "triangles": len(free_map.triangles),
        "moves": mission.moves,
        "role_exchanges": mission.role_exchanges,
        "travel_m": dict(mission.travel_m),
        "travel_over_perimeter": sum(mission.travel_m.values()) / run.world.perimeter_m,
        "mapped_area_m2": sum(area for _, area in run.dual_graph.nodes(data="area_m2")),
        **scores,
        "smoothed_moved_m": _largest_move(mission.estimate, run.final),
        "estimators": estimators,
    }


def _largest_move(causal: Estimate, final: Estimate) -> float:
    """How far the batch solve moved any map vertex away from where the driving estimator left it, m."""
    moves = [np.hypot(*(position(causal.vertex(v)) - position(final.vertex(v)))) for v in final.vertices]
    return float(max(moves, default=0.0))


def _write(run: Exploration, out: Path) -> None:
    """Trajectories, map, dual graph, pose graph and truth."""
    free_map, driver = run.mission.explorer.free_map, run.driver
    write_trajectories(out / "trajectories", run.final, run.mission.estimate)
    write_map(out / "map.geojson", free_map, run.final)
    write_dual_graph(out / "dual_graph.json", run.dual_graph)
    write_pose_graph(out, driver.graph, run.final)
    truth = out / "truth"
    truth.mkdir(exist_ok=True)
    write_json(truth / "world.geojson", run.world.to_geojson())
    write_json(truth / "vertices.json", {str(v): list(run.world.ring_index(c)) for v, c in run.truth.corner_of.items()})
    for robot, track in run.truth.tracks.items():
        write_tum(truth / f"{robot}.tum", track.stamps_s, track.poses)


def _view(run: Exploration) -> RunView:
    """What the figures show, in the frame of the estimate."""
    free_map, mission = run.mission.explorer.free_map, run.mission
    origin = next(iter(run.truth.tracks.values())).poses[0]

    def path(trajectory: Trajectory) -> np.ndarray:
        return np.array([position(pose) for pose in trajectory.poses])

    def at_start(points: np.ndarray) -> np.ndarray:
        return np.array([origin.transformTo(point) for point in points])

    robots = run.settings.team.robots
    paths = {
        "dead-reckoning": {robot: path(run.dead_reckoning.trajectory(robot)) for robot in robots},
        "causal": {robot: path(mission.estimate.causal_trajectory(robot)) for robot in robots},
        "smoothed": {robot: path(run.final.trajectory(robot)) for robot in robots},
        "true": {robot: at_start(path(track)) for robot, track in run.truth.tracks.items()},
    }
    return RunView(
        name=run.world.name,
        summary=run.summary,
        vertices={v: position(run.final.vertex(v)) for v in free_map.fans},
        covariances={v: run.final.vertex_belief(v).position_covariance for v in free_map.fans},
        triangles=dict(free_map.triangles),
        walls=free_map.walls(),
        gates=sorted(free_map.gates),
        dual_graph=run.dual_graph,
        paths=paths,
        history=[
            UncertaintyPoint(p.stamp_s, p.role_exchanges, p.travel_m, p.triangles, p.position_sigma_m)
            for p in mission.history
        ],
        true_rings=[at_start(ring) for ring in run.world.rings],
        true_vertices={v: at_start([position(run.truth.corners[c])])[0] for v, c in run.truth.corner_of.items()},
    )
