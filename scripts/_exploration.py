"""Build a simulated exploration from settings, run it, and write everything that is to be known of it.

A run that ends badly is written like any other; what could not be computed is named in summary["left_out"].
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from math import isfinite
from pathlib import Path
from typing import Literal, TypeVar

import networkx as nx
import numpy as np

from coopslam import __version__
from coopslam.errors import BadInput, CoopSlamError, UnderDetermined
from coopslam.estimation.batch import Batch, BatchEstimate, chi_square, solve_batch
from coopslam.estimation.dead_reckoning import DeadReckoning
from coopslam.estimation.estimate import Estimate, Trajectory
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.evaluation.exploration_score import (
    ExplorationTruth,
    bound_on_ate,
    causal_ate_rmse_m,
    score_trajectories,
    score_triangulation,
    score_vertices,
)
from coopslam.exploration.explorer import Explorer, ExplorerSettings
from coopslam.exploration.mission import Budget, Mission, Progress, run_mission
from coopslam.io.run_log import RunLogWriter
from coopslam.io.toml import dump_toml, to_mapping
from coopslam.io.tum import write_tum
from coopslam.planning.dual_graph import dual_graph, signed_area_m2
from coopslam.planning.recorded_odometry import RecordedOdometry
from coopslam.records import CornerDecision, LogHeader, MoveNote, Record
from coopslam.report import figures, html
from coopslam.report.run_directory import (
    write_dual_graph,
    write_json,
    write_map,
    write_pose_graph,
    write_trajectory,
)
from coopslam.report.run_view import RunView, UncertaintyPoint
from coopslam.se2 import Pose2, position
from sim.noise import PRESETS, Noise
from sim.sensors import Sensors
from sim.team import Team, TeamSettings, Truth
from sim.world import World, load_world, world_names

DRIVERS = {"incremental": Incremental, "batch": Batch}
WORST_CHI_SQUARE = 25.0  # per degree of freedom; 1 expected. Beyond, the estimate contradicts the records
ENOUGH_DOF = 50  # for that to be no chance
T = TypeVar("T")


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
        """The same with the noise spelled out. Raises BadInput when a belief leaves no room for doubt."""
        true, believed = PRESETS[self.noise]
        true, believed = self.true_noise or true, self.believed_noise or believed
        for part in fields(believed):
            for key, sigma in to_mapping(getattr(believed, part.name)).items():
                if not sigma > 0:
                    raise BadInput(f"believed_noise.{part.name}.{key}: more than zero expected, got {sigma}")
        return replace(self, true_noise=true, believed_noise=believed)

    @property
    def noise_name(self) -> str:
        """The preset that the noise in force equals, or "custom"."""
        true, believed = PRESETS[self.noise]
        in_force = (self.true_noise or true, self.believed_noise or believed)
        return next((name for name, preset in PRESETS.items() if preset == in_force), "custom")


@dataclass(frozen=True, slots=True)
class Prepared:
    """An exploration before the first move: everything that settings can get wrong is behind it."""

    settings: ExplorationSettings  # resolved
    world: World
    team: Team
    driver: Incremental | Batch
    explorer: Explorer


class LeftOut(dict):
    """What could not be computed or written: name -> reason."""

    def attempt(self, name: str, function: Callable[..., T], *arguments) -> T | None:
        """What the function returns; None, with the reason noted, when it cannot."""
        try:
            return function(*arguments)
        except (CoopSlamError, np.linalg.LinAlgError) as error:
            self.setdefault(name, " ".join(str(error).split()))  # the first reason is the cause
            return None


@dataclass(slots=True)
class Exploration:
    """A finished run: what drove, what smoothed, and what was true."""

    settings: ExplorationSettings
    world: World
    mission: Mission
    driver: Incremental | Batch
    truth: ExplorationTruth
    batch: BatchEstimate | None = None
    dead_reckoning: Estimate | None = None
    dual_graph: nx.Graph | None = None
    seconds: dict[str, float] = field(default_factory=dict)  # by estimator
    left_out: LeftOut = field(default_factory=LeftOut)
    summary: dict = field(default_factory=dict)

    @property
    def final(self) -> Estimate:
        """The best estimate there is: the batch solution, or else the driver's. Raises UnderDetermined without any."""
        estimate = self.batch or self.mission.estimate
        if estimate is None:
            raise UnderDetermined(f"there is no estimate of anything: {self.mission.reason}")
        return estimate


def prepare(settings: ExplorationSettings) -> Prepared:
    """World, sensors and robots. Raises BadInput for what is wrong with the settings; nothing is written."""
    settings = settings.resolved()
    world = load_world(settings.world)
    if settings.world not in world_names():
        settings = replace(settings, world=str(Path(settings.world).absolute()))  # config.toml is read from anywhere
    sensors = Sensors(settings.true_noise, settings.believed_noise, np.random.default_rng(settings.seed))
    team = Team(world, sensors, settings.team)
    robots = settings.team.robots
    driver = Incremental(robots, settings.incremental) if settings.estimator == "incremental" else Batch(robots)
    return Prepared(settings, world, team, driver, Explorer(robots, settings.explorer))


def explore(ready: Prepared, out: Path, watch: Callable[[Progress], None] | None = None) -> Exploration:
    """Explore, smooth, evaluate; the run directory `out` exists and gets everything but the figures."""
    began = time.perf_counter()
    settings, world = ready.settings, ready.world
    (out / "config.toml").write_text(dump_toml(to_mapping(settings)), encoding="utf-8")

    records: list[Record] = []
    with RunLogWriter(out / "log.mcap", _header(settings, world)) as log:

        def keep(record: Record) -> None:
            records.append(record)
            log.append(record)
            if isinstance(record, MoveNote):
                log.flush()  # what a move brought is safe before the next

        mission = run_mission(ready.team, ready.driver, ready.explorer, keep, settings.budget, watch)

    run = Exploration(settings, world, mission, ready.driver, _truth(ready.team.truth, world, records))
    _smooth(run, records)
    run.dual_graph = run.left_out.attempt("dual_graph.json", _dual_graph, run)
    run.summary = _summary(run)
    _write(run, out)
    run.summary["total_seconds"] = time.perf_counter() - began
    _write_summary(run, out)
    return run


def draw(run: Exploration, out: Path) -> None:
    """figures/ and report.html of a run, which both go into its directory."""
    known = len(run.left_out)
    view = _view(run)
    drawn = [] if run.settings.figures == "none" else figures.draw_all(view, out / "figures")
    html.write_report(out / "report.html", view, drawn)
    if len(run.left_out) > known:
        _write_summary(run, out)


def _write_summary(run: Exploration, out: Path) -> None:
    """summary.json, with what was left out and why, if anything was."""
    if run.left_out:
        run.summary["left_out"] = dict(run.left_out)
    write_json(out / "summary.json", run.summary)


def _smooth(run: Exploration, records: list[Record]) -> None:
    """The batch solution and odometry alone. A map that they contradict is not complete."""
    mission, robots = run.mission, run.settings.team.robots
    began = time.perf_counter()
    values = run.left_out.attempt(
        "estimators.batch", lambda: solve_batch(run.driver.graph, run.driver.values(), robots)
    )
    run.seconds = {"batch": time.perf_counter() - began}
    reckoner = DeadReckoning(robots)
    run.dead_reckoning = run.left_out.attempt("estimators.dead-reckoning", reckoner.update, records)
    run.seconds |= {"dead-reckoning": reckoner.timing, run.settings.estimator: run.driver.timing}
    if values is None:
        doubt = f"the final estimate failed: {run.left_out['estimators.batch']}"
    else:
        run.batch = BatchEstimate(run.driver.timeline, run.driver.graph, values)
        squares, dof = chi_square(run.driver.graph, values)
        if dof < ENOUGH_DOF or squares <= WORST_CHI_SQUARE * dof:
            return
        doubt = f"the estimate does not explain the records (chi-square per degree of freedom: {squares / dof:.3g})"
    if mission.outcome == "complete" or (mission.outcome == "budget" and values is not None):
        mission.outcome, mission.reason = "stuck", doubt


def _dual_graph(run: Exploration) -> nx.Graph:
    return dual_graph(run.mission.explorer.free_map, run.final, RecordedOdometry(run.driver.graph, run.final))


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


def _summary(run: Exploration) -> dict:
    """The figures of CONTRACT; everything but keys that end in _seconds is the same for the same settings."""
    mission, free_map, attempt = run.mission, run.mission.explorer.free_map, run.left_out.attempt
    summary = {
        "world": run.world.name,
        "seed": run.settings.seed,
        "noise": run.settings.noise_name,
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
        "mapped_area_m2": attempt("mapped_area_m2", _mapped_area_m2, run),
        **(attempt("scores of the triangulation", score_triangulation, free_map, run.truth) or {}),
        **(attempt("scores of the vertices", lambda: score_vertices(free_map, run.final, run.truth)) or {}),
        "smoothed_moved_m": attempt("smoothed_moved_m", lambda: _largest_move(mission.estimate, run.final)),
        "estimators": _estimators(run),
    }
    return {key: _finite(key, value, run.left_out) for key, value in summary.items() if value is not None}


def _estimators(run: Exploration) -> dict[str, dict]:
    """The scores of each estimator that came to an estimate."""
    attempt, mission = run.left_out.attempt, run.mission
    bound = attempt("crlb_ratio", lambda: bound_on_ate(run.driver.graph, run.final, run.truth))
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


def _write(run: Exploration, out: Path) -> None:
    """Trajectories, map, dual graph, pose graph and truth."""
    free_map, driver, attempt = run.mission.explorer.free_map, run.driver, run.left_out.attempt
    for robot in run.settings.team.robots:
        attempt(
            f"trajectories/{robot}.tum",
            lambda robot=robot: write_trajectory(out / "trajectories", robot, run.final, run.mission.estimate),
        )
    attempt("map.geojson", lambda: write_map(out / "map.geojson", free_map, run.final))
    if run.dual_graph is not None:
        write_dual_graph(out / "dual_graph.json", run.dual_graph)
    attempt("pose_graph.g2o", lambda: write_pose_graph(out, driver.graph, run.final))
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

    sources = {
        "dead-reckoning": lambda robot: run.dead_reckoning and run.dead_reckoning.trajectory(robot),
        "causal": lambda robot: mission.estimate and mission.estimate.causal_trajectory(robot),
        "smoothed": lambda robot: run.final.trajectory(robot),
    }
    paths = {kind: {} for kind in sources}
    for kind, trajectory_of in sources.items():
        for robot in run.settings.team.robots:
            trajectory = run.left_out.attempt(f"figures: {kind} path of {robot}", trajectory_of, robot)
            if trajectory is not None:
                paths[kind][robot] = path(trajectory)
    paths["true"] = {robot: at_start(path(track)) for robot, track in run.truth.tracks.items()}
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
        true_vertices={v: at_start([position(run.truth.corners[c])])[0] for v, c in run.truth.corner_of.items()},
    )


def _vertex_covariances(run: Exploration) -> dict[int, np.ndarray]:
    """(2, 2) each, map axes."""
    return {v: run.final.vertex_belief(v).position_covariance for v in run.mission.explorer.free_map.fans}
