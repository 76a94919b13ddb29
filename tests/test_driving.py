"""What happens on the way: corners passed, ground that slips, contact that seems lost."""

from dataclasses import replace
from math import pi, radians

import numpy as np
import pytest
import shapely
from monte_carlo import require_covariance

from coopslam.exploration.moves import FollowWall, GoToCorner, MoveEnd, Side
from coopslam.records import CornerSighting, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, compose_leg, xytheta
from sim.ground import Patch
from sim.noise import PRESETS, TYPICAL, FalseSightings, OdometryBias
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import World, load_world

A, B = "robot0", "robot1"
ROOM = [(0, 0), (10, 0), (10, 5), (0, 5)]
# beside the wall y = 0: corners (3, 0.3), (4, 0.3) of one pillar, (7, 0.4), (7.5, 0.4) of another
PILLARS = [[(3, 0.3), (3, 1), (4, 1), (4, 0.3)], [(7, 0.4), (7, 1), (7.5, 1), (7.5, 0.4)]]


def team_in(world: World, noise="none", seed=0, false=None, bias=None, **settings) -> Team:
    sensors = Sensors(*PRESETS[noise], np.random.default_rng(seed), bias or OdometryBias(), false or FalseSightings())
    team = Team(world, sensors, TeamSettings(**settings))
    team.begin()
    return team


def hall(*holes, patches=()) -> World:
    return World("hall", tuple(np.array(ring, float) for ring in (ROOM, *holes)), patches)


def sightings(step) -> list[CornerSighting]:
    return [record for record in step.records if isinstance(record, CornerSighting)]


def along_the_wall(team: Team):
    return team.execute(FollowWall(B, A, Side.RIGHT))


@pytest.mark.parametrize(("most", "expected"), [(0, []), (1, [3.0]), (2, [3.0, 4.0]), (3, [3.0, 4.0, 7.0]), (9, None)])
def test_the_nearest_corners_beside_the_way_are_sighted_where_they_are_nearest(most, expected):
    team = team_in(hall(*PILLARS), passing_corners_per_leg=most)
    step = along_the_wall(team)
    *passing, last = sightings(step)
    places = [team.truth.pose_at(B, seen.stamp_s).x() for seen in passing]
    assert places == pytest.approx([3.0, 4.0, 7.0, 7.5] if expected is None else expected)
    assert step.corner is last is step.records[-1] and last.stamp_s == step.stamp_s
    for seen in sightings(step):
        corner = team.truth.sighted[seen.stamp_s, B]
        world = team.world
        assert seen.interior_angle_rad == pytest.approx(world.interior_angle(corner))
        leaving = world.points[world.next_index[corner]] - world.points[corner]
        here = team.truth.pose_at(B, seen.stamp_s)
        there = Pose2(*world.points[corner], np.arctan2(leaving[1], leaving[0]))
        assert here.between(there).equals(seen.T_observer_corner, 1e-9)
        assert [r.observer for r in step.records if isinstance(r, RelativePoseFix) and r.stamp_s == seen.stamp_s] == [
            A,
            B,
        ]


def test_corners_out_of_reach_or_behind_a_wall_or_beyond_the_ends_are_not_sighted():
    team = team_in(hall(*PILLARS), finder_reach_m=0.35)
    assert len(sightings(along_the_wall(team))) == 3  # those at 0.3 m, and the end
    # the corner (3, 0) of a wall 10 cm thick hides (3.1, 0)'s far side; the pocket behind x = 3.1 is out of sight
    pocket = [(0, 0), (3, 0), (3, 2), (3.1, 2), (3.1, 0), (6, 0), (6, 4), (0, 4)]
    team = team_in(World("pocket", (np.array(pocket, float),)))
    along_the_wall(team)
    step = along_the_wall(team)  # from (3, 0) up to (3, 2): (3.1, 2) is not beside it, (3.1, 0) is behind the wall
    assert step.ended == MoveEnd.CORNER and len(sightings(step)) == 1
    open_air = team.execute(GoToCorner(B, A, (0.2, 0.0, 0.0), 1.0))
    assert not [r for r in sightings(open_air) if r is not open_air.corner]


def test_corners_side_by_side_do_not_share_a_stop():
    """A corridor whose two walls have their corners at the same places: one of each pair is sighted."""
    jags = [
        (0, 0),
        (4, 0),
        (4, -1),
        (5, -1),
        (5, 0),
        (9, 0),
        (9, 0.6),
        (5, 0.6),
        (5, 1.6),
        (4, 1.6),
        (4, 0.6),
        (0, 0.6),
    ]
    team = team_in(World("corridor", (np.array(jags, float),)), passing_corners_per_leg=9)
    team.execute(GoToCorner(B, A, (0.3, 0.3, 0.0), 1.0, limit_m=1.0))
    here = team.truth.pose_at(B, team.time_s)
    assert xytheta(here)[:2] == pytest.approx([0.6, 0.3])
    step = team.execute(GoToCorner(B, A, tuple(xytheta(here.between(Pose2(8.4, 0.3, 0.0)))), 1.0))
    passing = [team.truth.pose_at(B, seen.stamp_s).x() for seen in sightings(step)]
    assert passing == pytest.approx([4.0, 5.0])


@pytest.mark.parametrize("name", ["pillars", "rooms_with_doors", "cave"])
def test_every_sighting_on_the_way_is_in_reach_and_in_view(name):
    """Drives through the open, from anywhere to anywhere; shapely says what is in view, and what there is to sight."""
    world, rng = load_world(name), np.random.default_rng(4)
    drawn_out = world.polygon.buffer(1e-7, join_style="mitre")
    shapely.prepare(drawn_out)
    away = world.polygon.buffer(-0.01).difference(shapely.MultiPoint(world.points).buffer(0.5))
    shapely.prepare(away)
    team, compared, stamps = team_in(world, passing_corners_per_leg=3), 0, []
    low, high = world.points.min(axis=0), world.points.max(axis=0)
    for start, end in rng.uniform(low, high, (3000, 2, 2)):
        line = shapely.LineString([start, end])
        if not (shapely.contains_xy(away, [start, end]).all() and drawn_out.covers(line)):
            continue
        for body in (team._bodies[A], team._bodies[B]):  # both, so that contact holds
            body.position, body.corner, body.wall = start, None, None
        aim = team._bodies[B].pose.between(Pose2(*end, 0.0))
        step = team.execute(GoToCorner(B, A, tuple(xytheta(aim)), 1.0))
        assert step.ended == MoveEnd.NOTHING
        gaps = []
        for seen in sightings(step):
            corner = world.points[team.truth.sighted[seen.stamp_s, B]]
            here = team.truth.pose_at(B, seen.stamp_s).translation()
            gaps.append(float(np.hypot(*(corner - here))))
            assert gaps[-1] == pytest.approx(line.distance(shapely.Point(corner)), abs=1e-9)
            assert drawn_out.covers(shapely.LineString([here, corner]))
        stamps += [seen.stamp_s for seen in sightings(step)]
        # the nearest there are: corners in reach whose nearest place on the way shows them
        sights = shapely.shortest_line(shapely.points(world.points), line)
        metres = shapely.length(sights)
        there = np.flatnonzero((metres <= 0.5) & drawn_out.covers(sights))
        along = np.sort(line.project(shapely.points(world.points[there])))
        if len(there) < 2 or np.diff(along).min() > 0.011:
            assert np.sort(gaps) == pytest.approx(np.sort(metres[there])[:3])
            compared += len(there) > 0
        if compared == 15:
            break
    assert len(set(stamps)) == len(stamps) and compared == 15


def test_slippery_ground_shows_in_the_odometry_and_only_there():
    """Half of the way of 9.7 m lies on ground with three times the sigmas: variance 9 on it, 1 beside it."""
    slick = Patch(np.array([[5.15, -1.0], [11.0, -1.0], [11.0, 6.0], [5.15, 6.0]]), 3.0)
    ends, world = [], hall(patches=(slick,))
    for seed in range(700):
        team = team_in(world, "typical", seed, odometry_period_s=4.0, sightings_per_leg=1)
        odometry = [r for r in along_the_wall(team).records if isinstance(r, Odometry)]
        metres = 0.5 * (odometry[-1].stamp_s - odometry[-1].start_s)
        assert odometry[-1].cov_now[0, 0] == pytest.approx(0.03**2 * metres)  # the belief knows of no slippery ground
        ends.append([sum(r.T_start_now.x() for r in odometry) - 9.7, sum(r.T_start_now.theta() for r in odometry)])
    weighted = 4.85 * 1 + 4.85 * 9
    require_covariance(np.array(ends), np.diag([0.03**2 * weighted, radians(2.0) ** 2 * weighted]))


def test_a_turn_slips_by_the_place_where_it_happens():
    turned = {}
    for factor in (1.0, 10.0):
        patch = Patch(np.array([[9.5, -1.0], [11.0, -1.0], [11.0, 1.0], [9.5, 1.0]]), factor)
        errors = []
        for seed in range(400):
            team = team_in(hall(patches=(patch,)), "typical", seed, odometry_period_s=30.0, sightings_per_leg=1)
            along_the_wall(team)
            turn = along_the_wall(team).records[0]  # a quarter of a turn, in the corner (10, 0)
            errors.append(turn.T_start_now.theta() - pi / 2)
        turned[factor] = np.std(errors)
    assert turned[1.0] == pytest.approx(radians(3.0) / 2, rel=0.15)
    assert turned[10.0] == pytest.approx(10 * radians(3.0) / 2, rel=0.15)


def test_a_biased_leg_ends_on_its_arc_at_any_rate():
    bias, legs = OdometryBias(scale=0.1, drift_rad_per_m=0.05), []
    for period in (0.1, 5.0):
        team = team_in(hall(*PILLARS), bias=bias, odometry_period_s=period)
        odometry = [r for r in along_the_wall(team).records if isinstance(r, Odometry)]
        legs.append(compose_leg([r.T_start_now for r in odometry], [r.cov_now for r in odometry])[0])
    bend, length = 0.05 * 9.7, 1.1 * 9.7
    arc = Pose2(length * np.sin(bend) / bend, length * (1 - np.cos(bend)) / bend, bend)
    assert all(leg.equals(arc, 1e-9) for leg in legs)


def ends_of_first_walls(confirmations: int, runs: int = 200) -> tuple[int, int]:
    """How many of so many walks along a wall in plain view ended with contact, and the stops before their ends."""
    lost, stops, world = 0, 0, hall()
    for seed in range(runs):
        team = team_in(world, seed=seed, false=FalseSightings(outliers=0.1, dropouts=0.2), confirmations=confirmations)
        start = team.time_s
        step = along_the_wall(team)
        x = team.truth.pose_at(B, team.time_s).x()
        assert team.time_s - start == pytest.approx((x - 0.3) / 0.5)
        if step.ended == MoveEnd.CONTACT:
            lost += 1
            assert step.corner is None and x < 10.0
            assert (x - 0.3) % (9.7 / 8) == pytest.approx(0.0, abs=1e-6) or (x - 0.3) % (9.7 / 8) > 9.7 / 8 - 1e-6
        else:
            assert step.ended == MoveEnd.CORNER and x == pytest.approx(10.0)
        stops += min(round((x - 0.3) / (9.7 / 8)), 7)
    return lost, stops


def test_one_bad_sighting_ends_a_move_only_when_one_is_enough():
    """Each of the seven stops before the corner ends the move with probability 0.3: the law of a first success."""
    lost, stops = ends_of_first_walls(1)
    assert abs(lost - 0.3 * stops) < 5 * np.sqrt(0.3 * 0.7 * stops)
    assert lost > 150
    lost, _ = ends_of_first_walls(5)  # 1400 stops of 0.3^5 = 0.24 %: 3.4 expected
    assert lost < 15


def test_a_robot_that_lost_contact_stands_at_its_wall_and_can_go_on():
    team = team_in(hall(), false=FalseSightings(outliers=0.5, dropouts=0.4), confirmations=1)
    for _ in range(100):
        step = along_the_wall(team)
        if step.ended == MoveEnd.CORNER:
            break
        assert step.ended == MoveEnd.CONTACT
    assert xytheta(team.truth.pose_at(B, team.time_s))[:2] == pytest.approx([10, 0])


def test_the_belief_about_passed_corners_is_honest():
    """The corner (3, 0.3) at 0.3 m: across the line of sight, which is along the drive, the sigma is larger."""
    errors, claimed, world = [], [], hall(*PILLARS)
    noise = replace(TYPICAL, finder=replace(TYPICAL.finder, direction_sigma_rad=radians(3.0)))
    for seed in range(500):
        sensors = Sensors(noise, noise, np.random.default_rng(seed))
        team = Team(world, sensors, TeamSettings(passing_corners_per_leg=1, odometry_period_s=30.0))
        team.begin()
        seen = sightings(along_the_wall(team))[0]
        errors.append(xytheta(seen.T_observer_corner) - [0.0, 0.3, pi / 2])
        claimed.append(seen.cov_observer)
    require_covariance(np.array(errors), np.mean(claimed, axis=0))
    assert np.mean(claimed, axis=0)[0, 0] == pytest.approx(0.005**2 + (0.3 * radians(3.0)) ** 2, rel=0.02)
