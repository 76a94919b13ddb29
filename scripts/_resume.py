"""An exploration that goes on with the map of an earlier run: what that run left behind, and the two parts of the new.

Truth of the earlier run is read for evaluation alone.
"""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from _exploration import Exploration, Prepared, driver_of, header_of, keeper, truth_of
from _exploration_settings import ExplorationSettings

from coopslam.errors import BadInput, BadRecord, UnderDetermined
from coopslam.estimation.estimate import Trajectory
from coopslam.estimation.offline import smooth
from coopslam.evaluation.exploration_score import ExplorationTruth
from coopslam.exploration.mission import Mission, Progress, run_mission
from coopslam.exploration.rebuilt_map import rebuilt_map
from coopslam.exploration.resume import OldSession, Relocalizer, extend, joint_records, renamed
from coopslam.io.geojson import read_json
from coopslam.io.run_log import RunLogWriter, read_run_log
from coopslam.io.toml import dump_toml, load_toml, to_mapping
from coopslam.io.tum import read_tum
from coopslam.planning.corner_map import CornerMap, corner_map, stored_corner_map
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.waking_up import WakingUp
from coopslam.records import CornerDecision, Record
from coopslam.report.recognition_figure import draw_recognition
from sim.team_settings import MOST_ROBOTS
from sim.world import World

PAST = re.compile(r"past(\d+)-")  # begins the names of robots of earlier sessions
PAUSE_S = 60.0  # between two sessions


@dataclass(frozen=True, slots=True, eq=False)
class OldRun:
    """A run directory, read."""

    path: Path
    names: dict[str, str]  # robot in that log -> in the joint one
    session: OldSession
    stored: CornerMap
    ended_s: float  # on the clock of its log

    def settings_for(self, settings: ExplorationSettings, keep_world: bool) -> ExplorationSettings:
        """Those of a session that comes later. keep_world: else it is in the world of this one."""
        robots = settings.team.robots
        if len(self.session.robots) + len(robots) > MOST_ROBOTS:
            held = f"the map holds the poses of {len(self.session.robots)} robots, and {len(robots)} come"
            raise BadInput(f"--resume-map {self.path}: {held}; at most {MOST_ROBOTS} in all sessions expected")
        if not keep_world:
            settings = replace(settings, world=load_toml(self.path / "config.toml").get("world", settings.world))
        return replace(settings, team=replace(settings.team, clock_s=self.ended_s + PAUSE_S))


def read_old_run(path: Path) -> OldRun:
    """Raises BadInput, with the file, for what is not the whole directory of a simulated exploration."""
    header, records = read_run_log(path / "log.mcap")
    sessions = [int(match[1]) for robot in header.robots if (match := PAST.match(robot))]
    past = f"past{max(sessions, default=0) + 1}-"
    names = {robot: robot if PAST.match(robot) else past + robot for robot in header.robots}
    try:
        estimate = smooth(records, header.robots).estimate
        free_map = rebuilt_map(records, estimate)
    except (BadRecord, UnderDetermined) as error:
        raise BadInput(f"{path / 'log.mcap'}: {error}") from error
    sighted = [record.sighting for record in records if isinstance(record, CornerDecision)]
    if not free_map.triangles:
        raise BadInput(f"{path / 'log.mcap'}: holds no triangle; a map expected")
    angle_sigma_rad = max(sighting.interior_angle_sigma_rad for sighting in sighted)
    graph = MapGraph.load(path / "dual_graph.json")
    if dict(graph.triangles) != free_map.triangles:
        raise BadInput(f"{path / 'dual_graph.json'}: its triangles are not those of log.mcap; one run expected")
    if graph.joint is None:
        stored = corner_map(free_map, estimate, angle_sigma_rad)
    else:
        stored = stored_corner_map(graph, angle_sigma_rad)
    session = OldSession(tuple(names.values()), [renamed(record, names) for record in records], free_map)
    return OldRun(path, names, session, stored, records[-1].stamp_s)


def resume(ready: Prepared, old: OldRun, out: Path, watch: Callable[[Progress], None] | None = None) -> Exploration:
    """Both parts of the mission; `out` gets config.toml, log.mcap and figures/recognition.png.

    As long as the place is not recognized it is an exploration like any other, and its log that of the new robots;
    afterwards the log holds both sessions.
    """
    began, settings, world, team = time.perf_counter(), ready.settings, ready.world, ready.team
    robots, records = settings.team.robots, []
    (out / "config.toml").write_text(dump_toml(to_mapping(settings)), encoding="utf-8")
    ask = WakingUp(old.stored, robots[0])
    explorer = Relocalizer(robots, settings.explorer, ask)
    with RunLogWriter(out / "log.mcap", header_of(settings, world)) as log:
        mission = run_mission(team, ready.driver, explorer, keeper(records, log), settings.budget, watch)
    if settings.figures != "none":
        _draw(old, ask, world.name, out)
    run = Exploration(settings, world, mission, ready.driver, truth_of(team.truth, world, records), began, records)
    run.resumed = _account(old, ask, mission)
    if mission.outcome == "complete":
        _extend(run, ready, old, out, watch)
    run.looks = dict(team.sensors.tally)
    return run


def _extend(
    run: Exploration, ready: Prepared, old: OldRun, out: Path, watch: Callable[[Progress], None] | None
) -> None:
    """The second part, after the place was recognized: the run is then one of both sessions."""
    settings, team = ready.settings, ready.team
    run.settings = replace(settings, team=replace(settings.team, robots=(*old.session.robots, *settings.team.robots)))
    joint = joint_records(old.session, run.mission, run.records)
    run.records, run.driver = list(joint), driver_of(run.settings)
    with RunLogWriter(out / "log.mcap", header_of(run.settings, run.world)) as log:
        log.extend(joint)
        log.flush()
        keep = keeper(run.records, log)
        run.mission = extend(team, run.driver, old.session, run.mission, joint, keep, settings.budget, watch)
    if run.mission.outcome == "complete" and old.stored.is_complete:
        run.mission.reason = f"the place is recognized, and the map was complete: {run.mission.reason}"
    run.truth = _joint_truth(old, ready, run.records[len(old.session.records) :])


def _draw(old: OldRun, ask: WakingUp, name: str, out: Path) -> None:
    """The last answer."""
    if ask.last_map is not None:
        (out / "figures").mkdir(exist_ok=True)
        figure = draw_recognition(old.stored, ask.last_map, ask.answers[-1][1], name)
        figure.savefig(out / "figures" / "recognition.png", dpi=150, facecolor="white")


def _account(old: OldRun, ask: WakingUp, found: Mission) -> dict:
    """What summary.json says of the wake-up."""
    account = {"map": str(old.path), "moves": found.moves, "triangles": 0}
    if not ask.answers:
        return account
    triangles, answer = ask.answers[-1]
    account |= {"triangles": triangles, "verdict": str(answer.verdict), "reason": answer.reason}
    account |= {"alternatives": answer.alternatives, "corners": len(answer.pairs)}
    if answer.belief is not None:
        account["position_sigma_m"] = answer.belief.position_sigma_m
        account["probability"] = answer.places[0].probability
    return account


def _joint_truth(old: OldRun, ready: Prepared, new: Sequence[Record]) -> ExplorationTruth:
    """What was true in both sessions. new: the records of the second."""
    folder, world = old.path / "truth", ready.world
    corner_of = _true_corners(folder / "vertices.json", world)
    truth = truth_of(ready.team.truth, world, new, corner_of)
    tracks = {}
    for robot, name in old.names.items():
        stamps_s, poses = read_tum(folder / f"{robot}.tum")
        tracks[name] = Trajectory(np.asarray(stamps_s), poses)
    return replace(truth, tracks=tracks | truth.tracks)


def _true_corners(path: Path, world: World) -> dict[int, int]:
    try:
        return {int(vertex): world.flat_index(*corner) for vertex, corner in read_json(path).items()}
    except (ValueError, TypeError, AttributeError, IndexError) as error:
        raise BadInput(f"{path}: not of the world {world.name}: {error}") from error
