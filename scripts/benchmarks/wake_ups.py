"""A team wakes up in a known world: after how many triangles does it know where it is, and is it ever wrong?

Every stored map is a whole exploration of its own, smoothed; every wake-up begins in a random corner, with other noise,
and explores until the place is recognized or nothing is left. Truth only judges the answers. A recognition is right
when every corner that it pairs is the same true corner in both maps. "lost": answers that leave out the true place.
"""

import sys
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from coopslam.estimation.batch import BatchEstimate
from coopslam.estimation.incremental import Incremental
from coopslam.estimation.robust import solve_robust
from coopslam.exploration.explorer import Explorer
from coopslam.exploration.mission import Budget, Mission, Progress, run_mission
from coopslam.planning.corner_map import CornerMap, corner_map
from coopslam.planning.place_recognition import PlaceRecognition, PlaceSettings, Recognition, Verdict
from coopslam.records import CornerDecision
from coopslam.se2 import xytheta
from sim.noise import TYPICAL
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import World, load_world

WORLDS = (
    *("cave", "comb", "corridor_side_rooms", "office_floor", "paper_one_obstacle", "paper_two_occluders"),
    *("pillars", "rooms_with_doors", "spiral", "zigzag_corridor"),
)
ANGLE_SIGMA_RAD = TYPICAL.finder.interior_angle_sigma_rad
WAKING = "the place is recognized"


class Found(Exception):
    """Ends a mission."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A mission and what is true of it."""

    team: Team
    explorer: Explorer
    driver: Incremental
    mission: Mission | None  # None: it was left before its end
    corner_of: dict[int, int]  # map vertex -> true corner


@dataclass(frozen=True, slots=True, eq=False)
class WakeUp:
    """How a team found out where it is, or did not."""

    answers: list[Recognition]  # after each triangle
    is_right: bool | None  # None: not recognized
    lost: int  # answers that leave out the true place
    error: np.ndarray | None  # (3,) of the pose of the first robot; its own axes
    nees: float | None


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("worlds", nargs="*", default=WORLDS, help="names or GeoJSON files; default: ten of ours")
    parser.add_argument("--stored", type=int, default=4, help="stored maps of each world; default: %(default)s")
    parser.add_argument("--wake-ups", type=int, default=5, help="in each stored map; default: %(default)s")
    parser.add_argument("--known", type=float, default=1.0, help="share of the moves after which a stored map ends")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    everything = []
    print(f"{'world':22s} wake-ups  right wrong open  lost   triangles: median  90 %  most   error cm  NEES (ideal 3)")
    for name in options.worlds:
        world = load_world(name)
        found = list(_wake_ups(world, options.stored, options.wake_ups, options.known, options.seed))
        _row(world.name, found)
        everything += found
    _row("all", everything)
    print(
        "last answers of those not recognized:", dict(Counter(_last(one) for one in everything if one.is_right is None))
    )
    taken = Counter(len(one.answers) for one in everything if one.is_right)
    print("recognized after so many triangles:", ", ".join(f"{n}: {taken[n]}" for n in sorted(taken)))
    return 0


def _wake_ups(world: World, stored: int, wake_ups: int, known: float, seed: int) -> Iterable[WakeUp]:
    """Wake-ups in stored maps, each of which is the first exploration of its world that did not get stuck."""
    rng = np.random.default_rng(seed)
    for _ in range(stored):
        old = _explore(world, 0, rng)
        while old.mission.outcome == "stuck":
            old = _explore(world, 0, rng)
        if known < 1:
            old = _explore(world, 0, rng, Budget(moves=max(int(known * old.mission.moves), 1)))
        recognition = PlaceRecognition(_stored(old))
        for _ in range(wake_ups):
            yield _wake_up(world, int(rng.integers(world.n)), rng, old, recognition)


def _explore(
    world: World,
    corner: int,
    rng: np.random.Generator,
    budget: Budget | None = None,
    watch: Callable[[Explorer, Incremental, Progress], None] | None = None,
) -> Run:
    ring, index = world.ring_index(corner)
    settings = TeamSettings(start_ring=ring, start_corner=index)
    team = Team(world, Sensors(TYPICAL, TYPICAL, np.random.default_rng(rng.integers(2**63))), settings)
    explorer, driver, records, mission = Explorer(settings.robots), Incremental(settings.robots), [], None
    try:
        look = watch and (lambda progress: watch(explorer, driver, progress))
        mission = run_mission(team, driver, explorer, records.append, budget, look)
    except Found:
        pass
    sighted = team.truth.sighted
    decisions = [record for record in records if isinstance(record, CornerDecision)]
    corner_of = {one.vertex: sighted[one.sighting.stamp_s, one.sighting.observer] for one in decisions}
    return Run(team, explorer, driver, mission, corner_of)


def _stored(run: Run) -> CornerMap:
    driver = run.driver
    solution = solve_robust(driver.graph, driver.timeline.refused, driver.values(), driver.timeline.robots)
    smoothed = BatchEstimate(driver.timeline, solution.graph, solution.values)
    return corner_map(run.explorer.free_map, smoothed, ANGLE_SIGMA_RAD)


def _wake_up(world: World, corner: int, rng: np.random.Generator, old: Run, recognition: PlaceRecognition) -> WakeUp:
    answers: list[Recognition] = []
    sizes: list[int] = []  # corners of the small map at each answer

    def ask(explorer: Explorer, driver: Incremental) -> None:
        sizes.append(len(explorer.free_map.fans))
        small = corner_map(explorer.free_map, driver.update(()), ANGLE_SIGMA_RAD, "robot0")
        answers.append(recognition.recognize(small))

    def look(explorer: Explorer, driver: Incremental, progress: Progress) -> None:
        if progress.triangles > len(answers):
            ask(explorer, driver)
            if answers[-1].verdict is Verdict.RECOGNIZED:
                raise Found(WAKING)

    new = _explore(world, corner, rng, watch=look)
    if new.mission is not None:
        ask(new.explorer, new.driver)  # the last walls are decided after the last triangle
    ids = recognition.stored.ids
    right = [[old.corner_of[ids[j]] == new.corner_of[i] for i, j in answer.pairs] for answer in answers[-1:]]
    lost = sum(_leaves_out_truth(*answer, old, new, ids) for answer in zip(answers, sizes, strict=True))
    if not answers or answers[-1].verdict is not Verdict.RECOGNIZED:
        return WakeUp(answers, None, lost, None, None)
    belief = answers[-1].belief
    true = old.team.truth.origin.between(new.team.truth.pose_at("robot0", new.team.time_s))
    error = xytheta(belief.T_world_body.between(true))
    nees = float(error @ np.linalg.solve(belief.cov_body, error))
    return WakeUp(answers, all(right[0]), lost, error, nees)


def _leaves_out_truth(answer: Recognition, size: int, old: Run, new: Run, ids: tuple[int, ...]) -> bool:
    """Whether the true place is none of those that an answer leaves open; one that names none leaves all open.

    Of a small map that shares fewer corners with the stored one than are needed, nothing is expected.
    """
    known = set(old.corner_of.values())
    shared = sum(new.corner_of[vertex] in known for vertex in range(size))
    says_nothing = not answer.places and answer.verdict is not Verdict.NONE
    if says_nothing or shared < PlaceSettings().least_corners:
        return False
    return not any(all(old.corner_of[ids[j]] == new.corner_of[i] for i, j in one.pairs) for one in answer.places)


def _last(one: WakeUp) -> str:
    if not one.answers:
        return "no triangle"
    last = one.answers[-1]
    return f"{last.verdict}, {last.alternatives} alternatives"


def _row(name: str, found: list[WakeUp]) -> None:
    right = [one for one in found if one.is_right]
    wrong, left_open = sum(one.is_right is False for one in found), sum(one.is_right is None for one in found)
    line = f"{name:22s} {len(found):8d} {len(right):6d} {wrong:5d} {left_open:4d} {sum(one.lost for one in found):5d}"
    if right:
        taken = [len(one.answers) for one in right]
        errors = [100 * float(np.hypot(*one.error[:2])) for one in right]
        nees = np.mean([one.nees for one in right])
        line += f"   {np.median(taken):17g} {np.quantile(taken, 0.9):5.3g} {max(taken):5d}"
        line += f"   {np.median(errors):8.1f}  {nees:.2f} +- {np.sqrt(6 / len(right)):.2f}"
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
