"""Teams of two to six: where they start, who sees whom, and what they report of each other."""

from itertools import combinations

import numpy as np
import pytest
import shapely

from coopslam.errors import BadMove
from coopslam.exploration.moves import DriveAway, FollowWall, GoToCorner, MoveEnd, ReturnAlongContact, Side
from coopslam.records import CornerSighting, RelativePoseFix
from coopslam.se2 import Pose2, xytheta
from sim.noise import PRESETS, FalseSightings, OdometryBias
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import World, load_world

NAMES = ("ann", "bob", "cleo", "dan", "eve", "fay")
# an L: from the arm x < 2, y > 2 the wall x = 4 is out of sight
L = [(0, 0), (4, 0), (4, 1), (2, 1), (2, 4), (0, 4)]


def team_in(ring, names=NAMES[:3], noise="none", seed=0, false=None, **settings) -> Team:
    world = World("hand-made", (np.array(ring, float),))
    sensors = Sensors(*PRESETS[noise], np.random.default_rng(seed), false_sightings=false or FalseSightings())
    return Team(world, sensors, TeamSettings(robots=names, **settings))


def place(team: Team, robot: str) -> np.ndarray:
    return xytheta(team.truth.pose_at(robot, team.time_s))[:2]


def fixes(records) -> list[RelativePoseFix]:
    return [record for record in records if isinstance(record, RelativePoseFix)]


def looks(records) -> list[tuple[str, str]]:
    return [(fix.observer, fix.target) for fix in fixes(records)]


@pytest.mark.parametrize("count", range(2, 7))
def test_the_second_robot_starts_farthest_along_the_wall(count):
    names = NAMES[:count]
    team = team_in(L, names)
    step = team.begin()
    assert place(team, "ann") == pytest.approx([0, 0])
    assert place(team, "bob") == pytest.approx([0.3 * (count - 1), 0])
    for k, name in enumerate(names[2:], start=1):
        assert place(team, name) == pytest.approx([0.3 * k, 0])
    assert step.corner is step.records[0] and step.corner.observer == "ann" and step.stamp_s == 0.0
    expected = [look for a, b in combinations(names, 2) for look in ((a, b), (b, a))]
    assert looks(step.records) == expected
    for fix in fixes(step.records):
        here, there = (team.truth.pose_at(robot, 0.0) for robot in (fix.observer, fix.target))
        assert fix.T_observer_target.equals(here.between(there), 1e-9)


def test_they_take_at_most_half_the_wall():
    team = team_in(L, NAMES, start_step_m=5.0)
    team.begin()
    assert place(team, "bob") == pytest.approx([2.0, 0]) and place(team, "fay") == pytest.approx([1.6, 0])


def test_everybody_who_sees_the_mover_exchanges_fixes_with_it():
    """Round the corner (2, 1): ann in (0, 0) sees bob all the way, cleo, who waits in the arm, only for a part."""
    team = team_in(L)
    team.begin()
    team.execute(GoToCorner("cleo", "ann", (0.7, 3.5, 0.0), 1.0))
    assert place(team, "cleo") == pytest.approx([1, 3.5])
    step = team.execute(FollowWall("bob", "ann", Side.RIGHT))
    assert step.ended == MoveEnd.CORNER
    # the line from cleo past (2, 1) meets y = 0 at x = 2.4
    stops = {}
    for fix in fixes(step.records):
        x, y = team.truth.pose_at("bob", fix.stamp_s).x(), team.truth.pose_at("bob", fix.stamp_s).y()
        assert y == pytest.approx(0.0, abs=1e-9)
        stops.setdefault(round(x, 6), set()).update({fix.observer, fix.target} - {"bob"})
    assert len(stops) >= 3
    assert {x: others == {"ann", "cleo"} for x, others in stops.items()} == {x: x < 2.4 for x in stops}
    assert all("ann" in others for others in stops.values())
    # the watcher comes first, each pair looks both ways
    first = [fix for fix in fixes(step.records) if fix.stamp_s == fixes(step.records)[0].stamp_s]
    assert looks(first) == [("ann", "bob"), ("bob", "ann"), ("cleo", "bob"), ("bob", "cleo")]


def test_only_the_watcher_is_a_partner_to_bump_into():
    team = team_in(L, NAMES[:3])
    team.begin()
    team.execute(FollowWall("bob", "ann", Side.RIGHT))
    assert team.execute(FollowWall("cleo", "ann", Side.RIGHT)).ended == MoveEnd.CORNER  # bob stands there
    team = team_in(L, NAMES[:3])
    team.begin()
    team.execute(FollowWall("bob", "ann", Side.RIGHT))
    assert team.execute(FollowWall("cleo", "bob", Side.RIGHT)).ended == MoveEnd.PARTNER


def hidden_from_bob() -> Team:
    """bob in (4, 0), ann between, cleo in the arm, where only ann sees it."""
    team = team_in(L)
    team.begin()
    team.execute(FollowWall("bob", "ann", Side.RIGHT))
    team.execute(GoToCorner("cleo", "ann", (0.7, 3.5, 0.0), 1.0))
    return team


def test_a_move_that_begins_out_of_the_watchers_sight_is_not_watched():
    team = hidden_from_bob()
    corner = team.truth.pose_at("cleo", team.time_s).between(Pose2(0.0, 4.0, -np.pi / 2))
    step = team.execute(GoToCorner("cleo", "bob", tuple(xytheta(corner)), np.pi / 2, watch_for_rad=0.3))
    assert step.ended == MoveEnd.CORNER and place(team, "cleo") == pytest.approx([0, 4])
    assert {"ann", "cleo"} == {robot for look in looks(step.records) for robot in look}
    step = team.execute(FollowWall("cleo", "bob", Side.RIGHT))  # down x = 0, into bob's sight at y = 2 and to ann
    assert step.ended == MoveEnd.CORNER and place(team, "cleo") == pytest.approx([0, 0])
    heights = {"ann": [], "bob": []}
    for fix in fixes(step.records):
        if fix.target == "cleo":
            heights[fix.observer].append(team.truth.pose_at("cleo", fix.stamp_s).y())
    # a stop each metre; at (0, 2) the line to bob touches the corner (2, 1), at (0, 0) cleo stands where ann does
    assert heights["ann"] == pytest.approx([3, 2, 1]) and heights["bob"] == pytest.approx([2, 1, 0], abs=1e-9)


def test_a_robot_that_goes_alone_goes_on_where_contact_breaks():
    """Up the wall x = 0, watched from (4, 0), contact breaks at y = 2."""
    for alone, ended, y in ((False, MoveEnd.CONTACT, 2.0), (True, MoveEnd.CORNER, 4.0)):
        team = team_in(L, NAMES[:2])
        team.begin()
        team.execute(FollowWall("bob", "ann", Side.RIGHT))
        step = team.execute(FollowWall("ann", "bob", Side.LEFT, alone=alone))
        assert step.ended == ended and place(team, "ann") == pytest.approx([0, y])
        heights = [team.truth.pose_at("ann", fix.stamp_s).y() for fix in fixes(step.records)]
        assert max(heights) == pytest.approx(2.0)


@pytest.mark.parametrize("kind", [ReturnAlongContact, DriveAway])
def test_without_contact_there_is_no_line_of_contact_to_drive_along(kind):
    with pytest.raises(BadMove, match="cleo.*bob does not see it"):
        hidden_from_bob().execute(kind("cleo", "bob"))


@pytest.mark.parametrize("seed", range(20))
def test_they_wait_until_everybody_has_seen_everybody(seed):
    """Half of all looks drop out: the first round alone would do in 1 of 64 teams of three."""
    team = team_in(L, noise="typical", seed=seed, false=FalseSightings(dropouts=0.5))
    step = team.begin()
    assert set(looks(step.records)) == {(a, b) for a in NAMES[:3] for b in NAMES[:3] if a != b}
    stamps = sorted({fix.stamp_s for fix in fixes(step.records)})
    assert set(stamps) <= set(np.arange(100) * 2.0) and step.stamp_s == team.time_s >= max(8.0, stamps[-1])
    assert {type(record) for record in step.records} == {CornerSighting, RelativePoseFix}
    for robot in NAMES[:3]:
        assert team.truth.pose_at(robot, team.time_s).equals(team.truth.pose_at(robot, 0.0), 0.0)


def test_at_the_start_they_look_several_times_when_some_looks_may_be_false():
    team = team_in(L, NAMES[:2], false=FalseSightings(outliers=0.1))
    assert len(fixes(team.begin().records)) == 10 and team.time_s == 8.0
    team = team_in(L, NAMES[:2])
    assert len(fixes(team.begin().records)) == 2 and team.time_s == 0.0
    blind = team_in(L, NAMES[:2], false=FalseSightings(dropouts=0.1), tracker_blind_m=0.5)
    assert fixes(blind.begin().records) == []  # nobody waits for what cannot come


def any_move(team: Team, rng: np.random.Generator):
    """A move that may make sense or not; corners are looked for about where they are."""
    world, bodies = team.world, team._bodies
    robot, watcher = map(str, rng.choice(team.settings.robots, 2, replace=False))
    watch = float(rng.uniform(-3, 3)) if rng.random() < 0.3 else None
    limit = float(rng.uniform(0, 4)) if rng.random() < 0.5 else None
    match rng.integers(4):
        case 0:
            return FollowWall(robot, watcher, Side.RIGHT if rng.random() < 0.5 else Side.LEFT, watch)
        case 1:
            return ReturnAlongContact(robot, watcher)
        case 2:
            return DriveAway(robot, watcher, limit)
    corner = int(rng.integers(world.n))
    there = world.points[corner] + rng.normal(0, 0.1, 2)
    aim = xytheta(bodies[robot].pose.between(Pose2(*there, float(rng.uniform(-3, 3)))))
    return GoToCorner(robot, watcher, tuple(aim), world.interior_angle(corner), watch, limit, bool(rng.random() < 0.5))


@pytest.mark.parametrize("name", ["rooms_with_doors", "cave", "slippery_hall"])
@pytest.mark.parametrize("count", [2, 4])
def test_whatever_they_are_told_nobody_drives_through_a_wall(name, count):
    world, rng = load_world(name), np.random.default_rng(count)
    drawn_out = world.polygon.buffer(1e-7, join_style="mitre")
    sensors = Sensors(*PRESETS["typical"], rng, OdometryBias(0.02, 0.02, 0.01), FalseSightings(0.1, 0.2))
    team = Team(world, sensors, TeamSettings(robots=NAMES[:count], confirmations=2))
    team.begin()
    ends = set()
    for _ in range(300):
        move = any_move(team, rng)
        track = team.truth.tracks[move.robot]
        known = len(track.poses)
        try:
            ends.add(team.execute(move).ended)
        except BadMove:
            continue
        driven = [pose.translation() for pose in track.poses[known - 1 :]]
        assert len(driven) < 2 or drawn_out.covers(shapely.LineString(driven)), move
        body = team._bodies[move.robot]
        if body.wall is not None:
            wall = world.points[[body.wall, world.next_index[body.wall]]]
            assert shapely.LineString(wall).distance(shapely.Point(body.position)) < 1e-6, move
    assert ends >= set(MoveEnd) - {MoveEnd.BEARING}  # few bearings are met by chance
