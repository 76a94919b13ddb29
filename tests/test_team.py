"""The simulated team in hand-made worlds: where a move ends is geometry that can be done on paper."""

from dataclasses import fields, is_dataclass, replace
from math import atan2, hypot, pi

import numpy as np
import pytest

from coopslam.errors import BadInput, BadMove
from coopslam.evaluation.trajectory_error import interpolate_se2
from coopslam.exploration.moves import DriveAway, FollowWall, GoToCorner, MoveEnd, ReturnAlongContact, Side
from coopslam.records import CornerSighting, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, xytheta
from sim.noise import PRESETS
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import World

A, B = "robot0", "robot1"
# an L: the corner 3 at (2, 1) is reflex; from (4, 0) it hides the wall x = 0 above y = 2
L = [(0, 0), (4, 0), (4, 1), (2, 1), (2, 4), (0, 4)]
SQUARE = [(0, 0), (6, 0), (6, 6), (0, 6)]
PILLAR = [(2.5, 2.5), (2.5, 2.75), (2.75, 2.75), (2.75, 2.5)]  # clockwise; flat indices 4 .. 7
# two rooms; the door between (4, 2) and (4, 3) in a wall 1 m thick
DOORWAY = [(0, 0), (4, 0), (4, 2), (5, 2), (5, 0), (9, 0), (9, 5), (5, 5), (5, 3), (4, 3), (4, 5), (0, 5)]


def world_of(outer, *holes, shift=(0.0, 0.0)) -> World:
    return World("hand-made", tuple(np.array(ring, float) + shift for ring in (outer, *holes)))


def team_in(world: World, noise="none", seed=0, **settings) -> Team:
    team = Team(world, Sensors(*PRESETS[noise], np.random.default_rng(seed)), TeamSettings(**settings))
    team.begin()
    return team


def place(team: Team, robot: str) -> np.ndarray:
    return xytheta(team.truth.pose_at(robot, team.time_s))[:2]


def follow(mover, side, watch=None):
    return FollowWall(mover, B if mover == A else A, side, watch)


def numbers(value):
    """Every number in a record or step, however deep."""
    if isinstance(value, Pose2):
        yield from xytheta(value)
    elif isinstance(value, np.ndarray):
        yield from value.ravel()
    elif is_dataclass(value):
        for entry in fields(value):
            yield from numbers(getattr(value, entry.name))
    elif isinstance(value, tuple | list):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, float | int) and not isinstance(value, bool):
        yield float(value)


def test_they_start_in_a_corner_and_a_step_along_its_wall():
    team = Team(world_of(L), Sensors(*PRESETS["none"], np.random.default_rng(0)), TeamSettings(start_corner=1))
    step = team.begin()
    assert place(team, A) == pytest.approx([4, 0]) and place(team, B) == pytest.approx([4, 0.3])
    assert team.truth.origin.theta() == pytest.approx(pi / 2)
    corner, *fixes = step.records
    assert xytheta(corner.T_observer_corner) == pytest.approx([0, 0, 0]) and corner.interior_angle_rad == pytest.approx(
        pi / 2
    )
    assert [(fix.observer, fix.target) for fix in fixes] == [(A, B), (B, A)]
    assert xytheta(fixes[0].T_observer_target) == pytest.approx([0.3, 0, 0])
    assert (step.corner, step.ended, step.travelled_m) == (corner, MoveEnd.CORNER, 0.0)
    short = team_in(world_of(L), start_corner=1, start_step_m=10.0)
    assert place(short, B) == pytest.approx([4, 0.5])  # at most half the wall


def test_following_a_wall_ends_in_its_corner():
    team = team_in(world_of(L))
    step = team.execute(follow(B, Side.RIGHT))
    assert step.ended == MoveEnd.CORNER and place(team, B) == pytest.approx([4, 0])
    assert step.travelled_m == pytest.approx(3.7)
    assert step.corner.observer == B and step.corner.interior_angle_rad == pytest.approx(pi / 2)
    # it arrives looking along x; the wall that leaves the corner goes up
    assert xytheta(step.corner.T_observer_corner) == pytest.approx([0, 0, pi / 2])
    assert team.truth.sighted[step.stamp_s, B] == 1
    step = team.execute(follow(B, Side.RIGHT))
    assert place(team, B) == pytest.approx([4, 1]) and step.travelled_m == pytest.approx(1.0)
    step = team.execute(follow(B, Side.LEFT))
    assert place(team, B) == pytest.approx([4, 0]) and step.corner.interior_angle_rad == pytest.approx(pi / 2)


def test_contact_breaks_where_the_corner_hides_the_robot_and_back_is_that_corner():
    team = team_in(world_of(L))
    team.execute(follow(B, Side.RIGHT))
    step = team.execute(follow(A, Side.LEFT))  # up the wall x = 0, watched from (4, 0)
    assert step.ended == MoveEnd.CONTACT and step.corner is None
    assert place(team, A) == pytest.approx([0, 2]) and step.travelled_m == pytest.approx(2.0)
    step = team.execute(ReturnAlongContact(A, B))
    assert step.ended == MoveEnd.CORNER and place(team, A) == pytest.approx([2, 1])
    assert step.corner.interior_angle_rad == pytest.approx(1.5 * pi) and team.truth.sighted[step.stamp_s, A] == 3
    assert step.travelled_m == pytest.approx(hypot(2, 1))
    step = team.execute(DriveAway(A, B))  # and straight on again, to the wall
    assert step.ended == MoveEnd.WALL and step.corner is None and place(team, A) == pytest.approx([0, 2])
    step = team.execute(follow(A, Side.RIGHT))  # it stands at that wall: down is with the wall on the right
    assert step.ended == MoveEnd.CORNER and place(team, A) == pytest.approx([0, 0])


def test_back_along_contact_with_nothing_between_is_the_partner():
    team = team_in(world_of(SQUARE))
    team.execute(follow(B, Side.RIGHT))
    team.execute(follow(A, Side.LEFT))
    step = team.execute(ReturnAlongContact(A, B))
    assert step.ended == MoveEnd.PARTNER and place(team, A) == pytest.approx([6, 0])
    assert step.corner.observer == A and team.truth.sighted[step.stamp_s, A] == 1


def test_following_a_wall_to_the_partner_says_so():
    team = team_in(world_of(L))
    team.execute(follow(B, Side.RIGHT))
    step = team.execute(follow(A, Side.RIGHT))
    assert step.ended == MoveEnd.PARTNER and place(team, A) == pytest.approx([4, 0]) and step.corner is not None


def test_the_watched_bearing_stops_the_robot_there():
    team = team_in(world_of(L))
    team.execute(follow(B, Side.RIGHT))
    step = team.execute(follow(B, Side.RIGHT, watch=atan2(0.75, 4)))  # the watcher looks along x from (0, 0)
    assert step.ended == MoveEnd.BEARING and step.corner is None and place(team, B) == pytest.approx([4, 0.75])
    step = team.execute(follow(B, Side.RIGHT, watch=atan2(0.5, 4)))  # behind it already
    assert step.ended == MoveEnd.CORNER and place(team, B) == pytest.approx([4, 1])


def test_the_bearing_behind_the_watcher_is_not_met():
    team = team_in(world_of(SQUARE), start_step_m=1.0)
    step = team.execute(follow(B, Side.RIGHT, watch=pi / 4 - pi))
    assert step.ended == MoveEnd.CORNER
    step = team.execute(follow(B, Side.RIGHT, watch=atan2(3, 6) - pi))  # opposite to where B will be
    assert step.ended == MoveEnd.CORNER
    step = team.execute(follow(B, Side.RIGHT, watch=atan2(6, 3) + 2 * pi))
    assert step.ended == MoveEnd.BEARING and place(team, B) == pytest.approx([3, 6])


def test_contact_before_the_bearing_and_the_bearing_before_contact():
    """The watcher at (4, 0) looks along x; contact breaks when the robot on x = 0 is at (0, 2)."""
    for bearing, ended, y in ((pi + atan2(-1.5, 4), MoveEnd.BEARING, 1.5), (pi + atan2(-2.5, 4), MoveEnd.CONTACT, 2.0)):
        team = team_in(world_of(L))
        team.execute(follow(B, Side.RIGHT))
        step = team.execute(follow(A, Side.LEFT, watch=bearing))
        assert step.ended == ended and place(team, A) == pytest.approx([0, y])


def test_driving_away_is_stopped_by_distance_wall_and_corner():
    team = team_in(world_of(DOORWAY), start_corner=11, start_step_m=0.5)  # A at (0, 5), B below it
    step = team.execute(DriveAway(B, A, limit_m=2.0))
    assert step.ended == MoveEnd.DISTANCE and place(team, B) == pytest.approx([0, 2.5])
    assert step.travelled_m == pytest.approx(2.0) and step.corner is None
    step = team.execute(DriveAway(B, A, limit_m=100.0))
    assert step.ended == MoveEnd.CORNER and place(team, B) == pytest.approx([0, 0]) and step.corner is not None
    # across the door: from (0, 0) to (4, 2), on to the far room's wall x = 9 at y = 4.5
    team = team_in(world_of(DOORWAY))
    team.execute(follow(B, Side.RIGHT))
    team.execute(follow(B, Side.RIGHT))
    assert place(team, B) == pytest.approx([4, 2])
    step = team.execute(DriveAway(B, A))
    assert step.ended == MoveEnd.WALL and place(team, B) == pytest.approx([9, 4.5])
    assert step.travelled_m == pytest.approx(hypot(5, 2.5))


@pytest.mark.parametrize(("heading", "found"), [(pi / 2, [4]), (0.0, [5]), (pi, [7]), (-pi / 2, [5, 7])])
def test_going_to_a_corner_homes_on_the_one_that_looks_like_it(heading, found):
    """All four corners of the pillar are as near to its middle; their directions tell them apart. 6 is out of sight."""
    team = team_in(world_of(SQUARE, PILLAR))
    step = team.execute(GoToCorner(A, B, (2.625, 2.625, heading), 1.5 * pi))
    assert step.ended == MoveEnd.CORNER and step.corner.interior_angle_rad == pytest.approx(1.5 * pi)
    assert team.truth.sighted[step.stamp_s, A] in found
    assert place(team, A) == pytest.approx(team.world.points[team.truth.sighted[step.stamp_s, A]])


def test_going_to_a_corner_that_is_not_there_finds_nothing():
    team = team_in(world_of(SQUARE, PILLAR))
    step = team.execute(GoToCorner(A, B, (1.0, 2.0, 0.0), 1.0))
    assert step.ended == MoveEnd.NOTHING and step.corner is None and place(team, A) == pytest.approx([1, 2])


def test_a_wall_in_the_way_is_followed_towards_the_corner():
    """From (1, 2), looking along atan2(2, 1): a corner is promised beyond the wall x = 6, and one beyond the pillar."""
    team = team_in(world_of(SQUARE, PILLAR))
    team.execute(GoToCorner(A, B, (1.0, 2.0, 0.0), 1.0))
    beyond = team.truth.pose_at(A, team.time_s).between(Pose2(8.0, 2.0, 0.0))
    step = team.execute(GoToCorner(A, B, tuple(xytheta(beyond)), 1.0))
    assert step.ended == MoveEnd.NOTHING and step.corner is None and place(team, A) == pytest.approx([6, 2])
    team = team_in(world_of(SQUARE, PILLAR))
    start = place(team, A)
    step = team.execute(GoToCorner(A, B, (4.0, 4.0, 0.0), 1.0))  # the diagonal meets the pillar's corner (2.5, 2.5)
    assert step.ended != MoveEnd.WALL and np.hypot(*(place(team, A) - start)) > np.hypot(2.5, 2.5) - 1e-9


def test_a_wall_leads_to_the_corner_that_the_aim_just_misses():
    """The corner (6, 0) is promised 20 cm beyond the wall: the robot meets the wall and finds it there."""
    team = team_in(world_of(SQUARE))
    step = team.execute(GoToCorner(A, B, (6.1, -0.2, pi / 2), pi / 2))
    assert step.ended == MoveEnd.CORNER and place(team, A) == pytest.approx([6, 0])


def test_going_a_part_of_the_way_to_a_corner():
    team = team_in(world_of(SQUARE, PILLAR))
    step = team.execute(GoToCorner(A, B, (3.0, 4.0, 0.0), 1.0, limit_m=1.5))
    assert step.ended == MoveEnd.DISTANCE and place(team, A) == pytest.approx([0.9, 1.2]) and step.corner is None


def test_going_to_a_corner_keeps_contact():
    team = team_in(world_of(L))
    team.execute(follow(B, Side.RIGHT))
    step = team.execute(GoToCorner(A, B, (0.0, 4.0, -pi / 2), pi / 2))  # the corner (0, 4), hidden from (4, 0)
    assert step.ended == MoveEnd.CONTACT and place(team, A) == pytest.approx([0, 2])


def moves(team: Team):
    """A little tour of the L."""
    yield team.execute(follow(B, Side.RIGHT))
    yield team.execute(follow(A, Side.LEFT))
    yield team.execute(ReturnAlongContact(A, B))
    yield team.execute(DriveAway(A, B, 1.0))
    yield team.execute(GoToCorner(A, B, (1.0, 0.1, 0.0), 1.5 * pi))


def test_a_step_holds_measurements_and_no_truth():
    """The world lies kilometres away from its origin: any world coordinate in a step would be a large number."""
    for noise in ("none", "typical"):
        team = Team(world_of(L, shift=(1e4, -2e4)), Sensors(*PRESETS[noise], np.random.default_rng(0)))
        steps = [team.begin(), *moves(team)]
        records = [record for step in steps for record in step.records]
        assert {type(record) for record in records} == {Odometry, RelativePoseFix, CornerSighting}
        assert max(abs(number) for step in steps for number in numbers(step)) < 100.0
        assert {f.name for f in fields(steps[0])} == {"stamp_s", "records", "ended", "travelled_m"}
        # shifting and turning the world changes nothing that robots sense
        turn = np.array([[0.6, -0.8], [0.8, 0.6]])
        turned = Team(world_of(np.array(L, float) @ turn.T), Sensors(*PRESETS[noise], np.random.default_rng(0)))
        again = list(numbers(tuple([turned.begin(), *moves(turned)])))
        assert again == pytest.approx(list(numbers(tuple(steps))), abs=1e-6)


def test_records_come_in_order_and_the_watcher_stands():
    team = team_in(world_of(L), "typical")
    steps = list(moves(team))
    stamps = [record.stamp_s for step in steps for record in step.records]
    assert stamps == sorted(stamps) and steps[-1].stamp_s == stamps[-1] == team.time_s
    for step, mover in zip(steps, (B, A, A, A, A), strict=True):
        odometry = [record for record in step.records if isinstance(record, Odometry)]
        assert {record.robot for record in odometry} == {mover}
        assert all(a.stamp_s == b.start_s for a, b in zip(odometry, odometry[1:], strict=False))
        fixes = [record for record in step.records if isinstance(record, RelativePoseFix)]
        assert [fix.observer for fix in fixes] == [B if mover == A else A, mover] * (len(fixes) // 2)
        assert 1 <= len(fixes) // 2 <= team.settings.sightings_per_leg + team.settings.passing_corners_per_leg


def test_exact_odometry_and_fixes_agree_with_the_truth():
    team = team_in(world_of(L))
    for step in moves(team):
        for record in step.records:
            if isinstance(record, Odometry):
                before, after = (team.truth.pose_at(record.robot, t) for t in (record.start_s, record.stamp_s))
                sampled = record.stamp_s in team.truth.tracks[record.robot].stamps_s
                if sampled and record.start_s in team.truth.tracks[record.robot].stamps_s:
                    assert before.between(after).equals(record.T_start_now, 1e-9)
            elif isinstance(record, RelativePoseFix):
                poses = [team.truth.pose_at(robot, record.stamp_s) for robot in (record.observer, record.target)]
                assert poses[0].between(poses[1]).equals(record.T_observer_target, 1e-9)


def test_closer_than_the_blind_range_the_tracker_sees_nothing():
    team = team_in(world_of(L), tracker_blind_m=0.5)
    step = team.execute(follow(B, Side.RIGHT))
    assert all(
        record.T_observer_target.range(np.zeros(2)) > 0.5
        for record in step.records
        if isinstance(record, RelativePoseFix)
    )
    step = team.execute(follow(A, Side.RIGHT))  # ends where the partner stands
    last = [record for record in step.records if record.stamp_s == step.stamp_s]
    assert [type(record) for record in last] == [Odometry, CornerSighting]


def test_truth_stands_still_while_the_robot_stands():
    team = team_in(world_of(L))
    *_, step = moves(team)
    track = team.truth.tracks[B]
    first_drive = team.truth.tracks[A].stamps_s[-1]
    arrived = next(t for t, pose in zip(track.stamps_s, track.poses, strict=True) if abs(pose.x() - 4.0) < 1e-12)
    assert arrived < first_drive == step.stamp_s
    # A moves only after B arrived: while B drives, A is at its start, whenever one asks
    times = np.linspace(0.0, arrived, 50)
    for pose in interpolate_se2(np.array(team.truth.tracks[A].stamps_s), team.truth.tracks[A].poses, times):
        assert xytheta(pose) == pytest.approx([0, 0, 0], abs=1e-9)
    # and B drives straight at its speed
    for t in np.linspace(0.0, arrived, 50):
        (pose,) = interpolate_se2(np.array(track.stamps_s), track.poses, np.array([t]))
        assert pose.x() == pytest.approx(0.3 + 0.5 * t) and pose.y() == pytest.approx(0.0)
    assert all(
        a <= b for track in team.truth.tracks.values() for a, b in zip(track.stamps_s, track.stamps_s[1:], strict=False)
    )


@pytest.mark.parametrize("period_s", [0.05, 0.5, 3.0])
def test_rates_change_the_samples_and_not_where_the_robots_are(period_s):
    team = team_in(world_of(L), odometry_period_s=period_s, sighting_period_s=2 * period_s)
    steps = list(moves(team))
    reference = team_in(world_of(L))
    assert [s.ended for s in steps] == [s.ended for s in moves(reference)]
    assert team.time_s == pytest.approx(reference.time_s)
    assert place(team, A) == pytest.approx(place(reference, A))
    odometry = [r for s in steps for r in s.records if isinstance(r, Odometry)]
    assert max(r.stamp_s - r.start_s for r in odometry) <= period_s + 1e-9


def test_the_seed_decides_the_noise():
    def story(seed):
        team = Team(world_of(L), Sensors(*PRESETS["typical"], np.random.default_rng(seed)))
        return list(numbers((team.begin(), *moves(team))))

    assert story(3) == story(3)
    assert story(3) != story(4)


@pytest.mark.parametrize("nonsense", ["go home", None])
def test_what_is_not_a_move_is_refused(nonsense):
    with pytest.raises(BadMove, match=repr(nonsense)):
        team_in(world_of(L)).execute(nonsense)


def test_moves_that_make_no_sense_where_the_robot_stands_are_refused():
    team = team_in(world_of(SQUARE, PILLAR))
    team.execute(GoToCorner(A, B, (1.0, 2.0, 0.0), 1.0))
    with pytest.raises(BadMove, match="robot0 cannot follow a wall"):
        team.execute(follow(A, Side.LEFT))
    team = team_in(world_of(L))
    team.execute(follow(B, Side.RIGHT))
    team.execute(follow(A, Side.RIGHT))
    with pytest.raises(BadMove, match="robot0 cannot drive away from robot1"):
        team.execute(DriveAway(A, B))


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        *[(name, value) for name in ("start_step_m", "speed_m_per_s", "turn_rate_rad_per_s") for value in (0.0, -1.0)],
        *[(name, value) for name in ("odometry_period_s", "sighting_period_s") for value in (0.0, -1.0)],
        ("speed_m_per_s", float("nan")),
        ("speed_m_per_s", 1e5),
        ("odometry_period_s", 1e-4),
        ("finder_reach_m", -0.1),
        ("tracker_blind_m", -0.1),
        ("sightings_per_leg", 0),
        ("confirmations", 0),
        ("passing_corners_per_leg", -1),
        ("robots", tuple("abcdefg")),
        ("robots", ("ann",)),
        ("robots", ()),
        ("robots", ("ann", "ann")),
        ("robots", ("ann", "Ann")),
        ("robots", ("ann", "../bob")),
        ("robots", ("ann", "")),
    ],
)
def test_settings_refuse_what_cannot_be(setting, value):
    with pytest.raises(BadInput, match=setting):
        replace(TeamSettings(), **{setting: value})


@pytest.mark.parametrize(
    "where", [dict(start_corner=6), dict(start_ring=1), dict(start_corner=-1), dict(start_ring=-1)]
)
def test_a_start_outside_the_world_is_refused(where):
    with pytest.raises(BadInput, match="start_ring, start_corner"):
        team_in(world_of(L), **where)


def test_they_may_start_at_a_hole():
    team = team_in(world_of(SQUARE, PILLAR), start_ring=1, start_corner=2)
    assert place(team, A) == pytest.approx([2.75, 2.75]) and place(team, B) == pytest.approx([2.75, 2.625])
    assert team.execute(follow(B, Side.RIGHT)).corner.interior_angle_rad == pytest.approx(1.5 * pi)
