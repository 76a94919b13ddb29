"""The one loop: the explorer decides, the team acts, the log keeps, the estimator smooths."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Protocol

from coopslam.errors import BadInput, BadMove, UnderDetermined
from coopslam.estimation.estimate import Estimate, Estimator
from coopslam.exploration.account import Stuck
from coopslam.exploration.crew import Decided
from coopslam.exploration.explorer import Explorer
from coopslam.exploration.free_map import MapConflict
from coopslam.exploration.moves import Move, Step
from coopslam.records import MoveNote, Record, RelativePoseFix


class Acting(Protocol):
    """A team of robots, real or simulated."""

    def begin(self) -> Step: ...

    def execute(self, move: Move) -> Step: ...


@dataclass(frozen=True, slots=True)
class Budget:
    """When to stop although gates are open."""

    moves: int = 100_000
    travel_m: float = 1e7

    def __post_init__(self):
        if not self.moves > 0:
            raise BadInput(f"moves: more than zero expected, got {self.moves}")
        if not 0 < self.travel_m < inf:
            raise BadInput(f"travel_m: more than zero and finite expected, got {self.travel_m:g}")


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the mission is, after a step."""

    stamp_s: float
    triangles: int
    vertices: int
    open_gates: int
    role_exchanges: int
    travel_m: float
    sightings: int  # fixes of robots by robots so far
    position_sigma_m: dict[str, float]  # by robot


@dataclass(slots=True)
class Mission:
    """What happened: outcome ("complete", "budget" or "stuck"), why, and the story so far."""

    explorer: Explorer
    outcome: str = "stuck"
    reason: str = "not begun"
    moves: int = 0
    role_exchanges: int = 0
    travel_m: dict[str, float] = field(default_factory=dict)
    sightings: int = 0
    history: list[Progress] = field(default_factory=list)
    estimate: Estimate | None = None


def run_mission(
    team: Acting,
    estimator: Estimator,
    explorer: Explorer,
    log: Callable[[Record], None],
    budget: Budget | None = None,
    watch: Callable[[Progress], None] | None = None,
    begun: Mission | None = None,
) -> Mission:
    """Explore until complete, stuck or out of budget. Every record goes to `log` before it is used.

    begun: what the same robots did before, under another explorer; its account goes on.
    """
    budget = budget or Budget()
    mission = replace(begun or Mission(explorer, travel_m=dict.fromkeys(explorer.robots, 0.0)), explorer=explorer)
    last_mover = None

    def use(records) -> None:
        for record in records:
            log(record)
        mission.estimate = estimator.update(records)
        explorer.look_at(mission.estimate)

    step = team.begin()
    try:
        use(step.records)
        actions, reply = explorer.actions(step), None
        while True:
            action = actions.send(reply)
            if isinstance(action, Decided):
                use(action.records)
                reply = None
                continue
            if mission.moves >= budget.moves or sum(mission.travel_m.values()) >= budget.travel_m:
                mission.outcome, mission.reason = "budget", _spent(mission, budget)
                return mission
            reply = step = team.execute(action)
            mission.moves += 1
            if action.robot in explorer.crew.pair:
                mission.role_exchanges += last_mover not in (None, action.robot)
                last_mover = action.robot
            mission.travel_m[action.robot] += step.travelled_m
            mission.sightings += sum(isinstance(record, RelativePoseFix) for record in step.records)
            use((*step.records, MoveNote(step.stamp_s, action.robot, action.watcher, repr(action), step.ended.value)))
            mission.history.append(_progress(mission, step))
            if watch:
                watch(mission.history[-1])
    except StopIteration as end:
        mission.outcome, mission.reason = "complete", end.value
    except (Stuck, MapConflict, UnderDetermined, BadMove) as error:
        mission.outcome, mission.reason = "stuck", str(error)
    return mission


def _progress(mission: Mission, step: Step) -> Progress:
    free_map = mission.explorer.free_map
    return Progress(
        step.stamp_s,
        len(free_map.triangles),
        len(free_map.fans),
        len(free_map.gates),
        mission.role_exchanges,
        sum(mission.travel_m.values()),
        mission.sightings,
        {robot: mission.estimate.belief(robot).position_sigma_m for robot in mission.explorer.robots},
    )


def _spent(mission: Mission, budget: Budget) -> str:
    gates = len(mission.explorer.free_map.gates)
    return (
        f"{mission.moves} moves and {sum(mission.travel_m.values()):.1f} m are spent "
        f"(allowed: {budget.moves} and {budget.travel_m:g} m); {gates} gates are still open"
    )
