"""Build a simulated exploration from settings, run it, and write everything that is to be known of it.

A run that ends badly is written like any other; what could not be computed is named in summary["left_out"].
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import isinf
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import gtsam
import networkx as nx
import numpy as np
from _exploration_output import summarize, view_of, write_run
from _exploration_settings import DRIVERS, ExplorationSettings

from coopslam import __version__
from coopslam.errors import BadInput, CoopSlamError, UnderDetermined
from coopslam.estimation.batch import BatchEstimate, chi_square
from coopslam.estimation.dead_reckoning import DeadReckoning
from coopslam.estimation.estimate import Estimate, Estimator, Trajectory
from coopslam.estimation.loss import Loss
from coopslam.estimation.robust import RobustSettings, RobustSolution, is_tracker_fix, solve_robust
from coopslam.estimation.timeline import TimelineSettings
from coopslam.evaluation.exploration_score import ExplorationTruth
from coopslam.exploration.explorer import Explorer
from coopslam.exploration.mission import Mission, Progress, run_mission
from coopslam.io.run_log import RunLogWriter
from coopslam.io.toml import dump_toml, to_mapping
from coopslam.planning.dual_graph import dual_graph
from coopslam.planning.recorded_odometry import RecordedOdometry
from coopslam.records import CornerDecision, LogHeader, MoveNote, Record, RelativePoseFix
from coopslam.report import figures, html
from coopslam.report.run_directory import write_json
from coopslam.report.run_view import RunView
from coopslam.se2 import Pose2
from sim.sensors import Sensors
from sim.team import Team, TeamSettings, Truth
from sim.vision import Eye, VisionSensors
from sim.world import World, load_world, world_names

WORST_CHI_SQUARE = 25.0  # per degree of freedom; 1 expected. Beyond, the estimate contradicts the records
ENOUGH_DOF = 50  # for that to be no chance
MOST_FALSE = 0.5  # of all sightings; beyond, there is no saying which half is true
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Prepared:
    """An exploration before the first move: everything that settings can get wrong is behind it."""

    settings: ExplorationSettings  # resolved
    world: World
    team: Team
    driver: Estimator
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
    driver: Estimator
    truth: ExplorationTruth
    began_s: float  # on time.perf_counter
    records: list[Record] = field(default_factory=list)  # everything that is in the log
    looks: dict[str, int] = field(default_factory=dict)  # of the robot tracker: what it was asked, what came of it
    resumed: dict = field(default_factory=dict)  # how the place in an old map was recognized; empty: begun anew
    solution: RobustSolution | None = None
    batch: BatchEstimate | None = None
    dead_reckoning: Estimate | None = None
    dual_graph: nx.Graph | None = None
    seconds: dict[str, float] = field(default_factory=dict)  # by estimator
    left_out: LeftOut = field(default_factory=LeftOut)
    summary: dict = field(default_factory=dict)

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """What the final estimate smooths: everything but false sightings."""
        return self.solution.graph if self.solution else self.driver.graph

    @property
    def final(self) -> Estimate:
        """The best estimate there is: the batch solution, or else the driver's. Raises UnderDetermined without any."""
        estimate = self.batch or self.mission.estimate
        if estimate is None:
            raise UnderDetermined(f"there is no estimate of anything: {self.mission.reason}")
        return estimate


def prepare(settings: ExplorationSettings) -> Prepared:
    """World, sensors and robots. Raises BadInput that begins with the dotted key; nothing is written."""
    settings = settings.resolved()
    try:
        world = load_world(settings.world)
    except BadInput as error:
        raise BadInput(f"world: {error}") from error
    _require_start(settings.team, world)
    if settings.world not in world_names():
        settings = replace(settings, world=str(Path(settings.world).absolute()))  # config.toml is read from anywhere
    settings = replace(settings, vision=settings.vision.placed())
    team = Team(world, _sensors(settings), settings.team)
    robots = settings.team.robots
    return Prepared(settings, world, team, driver_of(settings), Explorer(robots, settings.explorer))


def _sensors(settings: ExplorationSettings) -> Sensors:
    """Statistical models, or an eye for a tracker with a camera. The pictures have random numbers of their own."""
    rng = np.random.default_rng(settings.seed)
    models = (settings.true_noise, settings.believed_noise, rng, settings.bias, settings.false_sightings)
    if settings.tracker == "statistical":
        return Sensors(*models, settings.tracker_limits)
    eye = Eye(settings.sheet(), settings.vision, rng.spawn(1)[0])
    return VisionSensors(*models, settings.tracker_limits, eye=eye)


def driver_of(settings: ExplorationSettings) -> Estimator:
    """The estimator that the team steers by.

    The gate judges sightings with heading. False ones without are met by smoothers with a robust loss, by the filters
    with a gate of their own. A detector that withholds headings may err as well.
    """
    may_be_false = settings.false_sightings.outliers > 0 and not settings.tracker_limits.has_heading
    may_be_false = may_be_false or settings.tracker != "statistical"
    timeline = TimelineSettings(loss=Loss("cauchy")) if may_be_false else None
    own = {
        "incremental": {"settings": settings.incremental, "timeline": timeline},
        "fixed-lag": {"settings": settings.fixed_lag, "timeline": timeline},
        "batch": {"timeline": timeline},
        "ekf": {"settings": settings.ekf},
        "weighted": {"settings": settings.ekf},
    }.get(settings.estimator, {})
    return DRIVERS[settings.estimator](settings.team.robots, gate=settings.gate, **own)


def _require_start(team: TeamSettings, world: World) -> None:
    """Raises BadInput unless the team starts in a corner of the world."""
    if not 0 <= team.start_ring < len(world.rings):
        raise BadInput(f"team.start_ring: 0 to {len(world.rings) - 1} in this world expected, got {team.start_ring}")
    corners = len(world.rings[team.start_ring])
    if not 0 <= team.start_corner < corners:
        raise BadInput(f"team.start_corner: 0 to {corners - 1} in this ring expected, got {team.start_corner}")


def explore(ready: Prepared, out: Path, watch: Callable[[Progress], None] | None = None) -> Exploration:
    """Explore, smooth, evaluate; the run directory `out` exists and gets everything but the figures."""
    run = drive(ready, out, watch)
    conclude(run, out)
    return run


def drive(ready: Prepared, out: Path, watch: Callable[[Progress], None] | None = None) -> Exploration:
    """The mission alone; `out` gets config.toml and, move by move, log.mcap. An old map is resumed elsewhere."""
    began = time.perf_counter()
    settings, world = ready.settings, ready.world
    if settings.resume_map:
        raise BadInput("resume_map: explore_and_optimize.py resumes a map; nothing else does")
    (out / "config.toml").write_text(dump_toml(to_mapping(settings)), encoding="utf-8")

    records: list[Record] = []
    with RunLogWriter(out / "log.mcap", header_of(settings, world)) as log:
        keep = keeper(records, log)
        mission = run_mission(ready.team, ready.driver, ready.explorer, keep, settings.budget, watch)

    truth = truth_of(ready.team.truth, world, records)
    looks = dict(ready.team.sensors.tally)
    return Exploration(settings, world, mission, ready.driver, truth, began, records, looks)


def keeper(records: list[Record], log: RunLogWriter) -> Callable[[Record], None]:
    """What keeps each record in memory and on disk."""

    def keep(record: Record) -> None:
        records.append(record)
        log.append(record)
        if isinstance(record, MoveNote):
            log.flush()  # what a move brought is safe before the next

    return keep


def conclude(run: Exploration, out: Path) -> None:
    """Smooth and evaluate what a mission recorded; `out` gets the results."""
    _smooth(run, run.records)
    run.dual_graph = run.left_out.attempt("dual_graph.json", _dual_graph, run)
    run.summary = summarize(run)
    write_run(run, out)
    run.summary["total_seconds"] = time.perf_counter() - run.began_s
    _write_summary(run, out)


def draw(run: Exploration, out: Path) -> RunView:
    """figures/ and report.html of a run, which both go into its directory; what they show."""
    known = len(run.left_out)
    view = view_of(run)
    if run.settings.figures != "none":
        figures.draw_all(view, out / "figures")
    html.write_report(out / "report.html", view, figures.drawn_in(out / "figures"))
    if len(run.left_out) > known:
        _write_summary(run, out)
    return view


def _write_summary(run: Exploration, out: Path) -> None:
    """summary.json, with what was left out and why, if anything was."""
    if run.left_out:
        run.summary["left_out"] = dict(run.left_out)
    write_json(out / "summary.json", run.summary)


def _smooth(run: Exploration, records: list[Record]) -> None:
    """The batch solution and odometry alone. A map that they contradict is not complete."""
    mission, robots = run.mission, run.settings.team.robots
    driver, began = run.driver, time.perf_counter()
    run.solution = run.left_out.attempt("estimators.batch", _solution, driver, robots, run.settings.robust)
    run.seconds = {"batch": time.perf_counter() - began}
    reckoner = DeadReckoning(robots)
    run.dead_reckoning = run.left_out.attempt("estimators.dead-reckoning", reckoner.update, records)
    run.seconds |= {"dead-reckoning": reckoner.timing, run.settings.estimator: driver.timing}
    if run.solution is not None:
        run.batch = BatchEstimate(driver.timeline, run.graph, run.solution.values)
    doubt = _doubt(run)
    if doubt and (mission.outcome == "complete" or (mission.outcome == "budget" and run.solution is not None)):
        mission.outcome, mission.reason = "stuck", doubt


def _solution(driver: Estimator, robots: tuple[str, ...], settings: RobustSettings) -> RobustSolution:
    """Everything smoothed at once. Without a limit there is no deciding again: what the gate refused stays out."""
    refused = [factor for factor in driver.timeline.refused if is_tracker_fix(factor)]
    if isinf(settings.distance_sq_max):
        plain = solve_robust(driver.graph, (), driver.values(), robots, settings)
        return replace(plain, outliers=list(refused))
    return solve_robust(driver.graph, refused, driver.values(), robots, settings)


def _doubt(run: Exploration) -> str:
    """Why the final estimate cannot be believed; empty when it can."""
    if run.solution is None:
        return f"the final estimate failed: {run.left_out['estimators.batch']}"
    squares, dof = chi_square(run.graph, run.solution.values)
    if dof >= ENOUGH_DOF and squares > WORST_CHI_SQUARE * dof:
        return f"the estimate does not explain the records (chi-square per degree of freedom: {squares / dof:.3g})"
    false, fixes = len(run.solution.outliers), sum(isinstance(record, RelativePoseFix) for record in run.records)
    if fixes >= ENOUGH_DOF and false > MOST_FALSE * fixes:
        return f"{false} of {fixes} sightings of robots by robots look false"
    return ""


def _dual_graph(run: Exploration) -> nx.Graph:
    return dual_graph(run.mission.explorer.free_map, run.final, RecordedOdometry(run.graph, run.final))


def header_of(settings: ExplorationSettings, world: World) -> LogHeader:
    """Of the log of a simulated exploration."""
    models = {"tracker": settings.tracker, "believed_noise": to_mapping(settings.believed_noise)}
    if settings.tracker != "statistical":
        models["data_sheet"] = to_mapping(settings.sheet())
    provenance = f"simulated by coopslam {__version__}"
    return LogHeader(
        settings.team.robots, seed=settings.seed, world=world.name, sensor_models=models, provenance=provenance
    )


def truth_of(
    truth: Truth, world: World, records: Iterable[Record], known: Mapping[int, int] = MappingProxyType({})
) -> ExplorationTruth:
    """The simulator's truth in the words of the evaluation. known: map vertex -> true corner, from an earlier run."""
    corner_of, misnamed = dict(known), 0
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
