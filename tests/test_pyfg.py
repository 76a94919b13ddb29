import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import damaged

from coopslam.errors import BadInput
from coopslam.io.log import Log
from coopslam.io.pyfg import PyfgSource
from coopslam.records import (
    BearingRangeFix,
    LandmarkPrior,
    LoopClosure,
    Odometry,
    RangeFix,
    RelativePoseFix,
)
from coopslam.se2 import Pose2

SMALL = Path(__file__).parents[1] / "datasets" / "logs" / "two_robots.pyfg"
MRCLAM_6 = Path(__file__).parents[2] / "shared" / "data" / "pyfg" / "mrclam6.pyfg"
needs_mrclam_6 = pytest.mark.skipif(not MRCLAM_6.is_file(), reason="mrclam6.pyfg is not here")


def of_kind(log, kind):
    return [record for record in log.records if isinstance(record, kind)]


def test_the_small_graph_by_hand():
    log = PyfgSource(SMALL).read()
    assert (log.name, log.header.robots, log.header.landmarks) == ("two_robots.pyfg", ("A", "B"), ("L1", "L2"))
    assert not log.dropped
    assert Counter(type(record) for record in log.records) == {
        Odometry: 6,
        LoopClosure: 2,
        RelativePoseFix: 1,
        BearingRangeFix: 3,
        RangeFix: 2,
        LandmarkPrior: 1,
    }
    step = of_kind(log, Odometry)[0]
    assert (step.start_s, step.stamp_s, step.robot) == (100, 101, "A")
    assert step.T_start_now.equals(Pose2(2, 0, 1.5708), 0)
    np.testing.assert_array_equal(step.cov_now, np.diag([0.0004, 0.0004, 0.0001]))
    (fix,) = of_kind(log, RelativePoseFix)
    assert (fix.stamp_s, fix.observer, fix.target) == (102, "A", "B")
    # B is turned by -90 degrees (to 4e-6 rad), so its x axis, with 0.02 m, is A's y axis
    np.testing.assert_allclose(fix.cov_observer, np.diag([0.0001, 0.0004, 0.0009]), atol=1e-8)
    closures = [(c.earlier_robot, c.earlier_s, c.robot, c.stamp_s) for c in of_kind(log, LoopClosure)]
    assert closures == [("A", 100, "A", 104), ("B", 100, "A", 104)]
    (prior,) = of_kind(log, LandmarkPrior)  # the prior on A0 is the origin
    np.testing.assert_allclose(prior.xy, [1, 1], atol=1e-12)
    # 0.01 of its own, 0.01 of the origin's place, and 0.0025 rad^2 of its heading across the way of (1, 1) m
    np.testing.assert_allclose(prior.cov, [[0.0225, -0.0025], [-0.0025, 0.0225]], atol=1e-12)
    ranges = [(r.observer, r.target, r.range_m, r.sigma_m) for r in of_kind(log, RangeFix)]
    assert ranges == [("A", "B", 3.0, 0.1), ("B", "L1", 2.0, 0.2)]  # the file says variances


def test_the_vertices_are_the_truth():
    truth = PyfgSource(SMALL).truth()
    assert truth.robots.keys() == {"A", "B"}
    np.testing.assert_array_equal(truth.robots["B"].stamps_s, [100, 101, 102])
    assert truth.robots["A"].poses[1].equals(Pose2(12, 5, 1.5708), 0)
    np.testing.assert_array_equal(truth.landmarks["L2"], [12.5, 8])


def test_the_truth_never_reaches_a_record(tmp_path):
    """Other numbers in the vertices, the same records."""
    lines = SMALL.read_text().splitlines()
    for k, line in enumerate(lines):
        words = line.split()
        if words[0] in ("VERTEX_SE2", "VERTEX_XY"):
            named = 3 if words[0] == "VERTEX_SE2" else 2
            lines[k] = " ".join(words[:named] + ["77"] * (len(words) - named))
    (tmp_path / "a.pyfg").write_text("\n".join(lines) + "\n")
    assert PyfgSource(tmp_path / "a.pyfg").truth().landmarks["L1"].tolist() == [77, 77]
    assert repr(PyfgSource(tmp_path / "a.pyfg").read().records) == repr(PyfgSource(SMALL).read().records)


def test_all_stamps_the_same_as_in_the_examples_of_pyfactorgraph(tmp_path):
    text = SMALL.read_text()
    for stamp in range(100, 105):
        text = text.replace(f" {stamp}.0 ", " 0.5 ")
    (tmp_path / "a.pyfg").write_text(text)
    log = PyfgSource(tmp_path / "a.pyfg").read()
    assert list(log.dropped.values()) == [1]
    assert "do not ascend" in next(iter(log.dropped))
    assert {step.stamp_s for step in of_kind(log, Odometry)} == {1, 2, 3, 4}
    assert len(log.records) == len(PyfgSource(SMALL).read().records)
    np.testing.assert_array_equal(PyfgSource(tmp_path / "a.pyfg").truth().robots["A"].stamps_s, range(5))


def test_the_order_of_lines_makes_no_difference_to_what_is_recorded(tmp_path):
    lines = SMALL.read_text().splitlines()
    np.random.default_rng(0).shuffle(lines)
    (tmp_path / "a.pyfg").write_text("\r\n".join(lines))
    log, expected = PyfgSource(tmp_path / "a.pyfg").read(), PyfgSource(SMALL).read()
    assert sorted(map(repr, log.records)) == sorted(map(repr, expected.records))
    assert log.header.robots == expected.header.robots


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("VERTEX_SE3:QUAT 0.1 A9 0 0 0 0 0 0 1", r"line 2: 3-D graph \(VERTEX_SE3:QUAT, line 2\); 2-D expected"),
        ("EDGE_SE3_XYZ 0.1 A0 L1 0 0 0 1 0 0 1 0 1", r"line 2: 3-D graph \(EDGE_SE3_XYZ, line 2\); 2-D expected"),
        ("EDGE_WARP 0.1 A0 A1 5", "line 2: unknown tag 'EDGE_WARP'; expected one of VERTEX_SE2, VERTEX_XY"),
        ("EDGE_RANGE 1 A0 A1 5", "line 2: EDGE_RANGE takes a stamp, 2 name.* and 2 finite numbers, got 'EDGE_RANGE 1"),
        ("EDGE_RANGE 1 A0 A1 5 nan", "line 2: EDGE_RANGE takes"),
        ("EDGE_RANGE 1 A0 A1 five 1", "line 2: EDGE_RANGE takes"),
        ("EDGE_RANGE 1 A0 L1 5 -1", "line 2: the variance -1 of a range; expected more than zero"),
        ("EDGE_RANGE 1 A0 L1 5 0", "line 2: the variance 0 of a range; expected more than zero"),
        ("EDGE_RANGE 1 A0 L1 -5 1", "line 2: A reports the range -5.0 m"),
        ("VERTEX_SE2 inf A9 0 0 0", "line 2: the time stamp inf; expected seconds"),
        ("VERTEX_SE2 1e12 A9 0 0 0", r"line 2: the time stamp 1e\+12; expected seconds"),
        ("VERTEX_SE2 0 17 0 0 0", "line 2: the pose '17'; expected letters and a number, such as A0"),
        ("VERTEX_SE2 0 A0 0 0 0", "line .*: A0 is there already"),
        ("EDGE_SE2_XY 1 A0 L9 1 1 1 0 1", "line 2: there is no vertex L9 that is a pose or landmark"),
        (
            "EDGE_SE2 1 A0 A2 0 0 0 1 0 0 -1 0 1",
            r"line 2: the covariance \[1.0, 0.0, 0.0, -1.0, .*; expected a positive",
        ),
        ("EDGE_SE2_XY 1 A0 L1 1 1 0 0 0", r"line 2: the covariance \[0.0, 0.0, 0.0\]; expected a positive definite"),
        ("VERTEX_SE2", "line 2: VERTEX_SE2 takes"),
        ("VERTEX_XY L\0 0 0", r"line 2: the name 'L.x00'; expected up to 60 printable characters"),
        ("EDGE_RANGE 1 A0 " + "L" * 5000 + " 5 1", "line 2: the name 'LLLL.*; expected up to 60 printable"),
    ],
)
def test_bad_lines_are_named(tmp_path, line, message):
    path = tmp_path / "a.pyfg"
    path.write_text(f"# a comment\n{line}\n{SMALL.read_text()}")
    with pytest.raises(BadInput, match=rf"a\.pyfg: {message}") as caught:
        PyfgSource(path).read()
    assert "\n" not in str(caught.value)


def test_a_last_line_that_is_cut_off_is_counted(tmp_path):
    (tmp_path / "a.pyfg").write_text(SMALL.read_text()[:-5])
    log = PyfgSource(tmp_path / "a.pyfg").read()
    assert log.dropped == {"line 26 is cut off": 1}
    assert len(log.records) == len(PyfgSource(SMALL).read().records) - 1


def test_a_graph_that_was_cut_before_its_odometry_ends_says_what_is_unknown(tmp_path):
    lines = SMALL.read_text().splitlines(keepends=True)
    (tmp_path / "a.pyfg").write_text("".join(lines[:15]))  # three of the six legs
    log = PyfgSource(tmp_path / "a.pyfg").read()
    assert log.dropped == {"odometry: none between consecutive poses; taken as unknown motion": 3}
    assert len(of_kind(log, Odometry)) == 6


def test_what_is_no_pose_graph(tmp_path):
    path = tmp_path / "a.pyfg"
    for content, message in (
        (b"", "no poses in it"),
        (b"# nothing\n", "no poses in it"),
        (b"VERTEX_SE2 0 A0 0 0 0\n", "no edges in it"),
        (np.random.default_rng(0).integers(0, 256, 2000, dtype=np.uint8).tobytes(), "not a text file"),
    ):
        path.write_bytes(content)
        with pytest.raises(BadInput, match=rf"a\.pyfg: {message}"):
            PyfgSource(path).read()
    with pytest.raises(BadInput, match="not a file; expected a pose graph of PyFactorGraph"):
        PyfgSource(tmp_path).read()
    with pytest.raises(BadInput, match="b.pyfg: cannot be read: No such file"):
        PyfgSource(tmp_path / "b.pyfg").read()


@settings(max_examples=200)
@given(damaged(SMALL.read_bytes()), st.sampled_from(["read", "truth"]))
def test_damage_is_read_over_or_named_in_one_line(tmp_path_factory, content, method):
    path = tmp_path_factory.getbasetemp() / "damaged.pyfg"
    path.write_bytes(content)
    try:
        result = getattr(PyfgSource(path), method)()
    except BadInput as error:
        assert str(error).isprintable()
    else:
        assert method == "truth" or isinstance(result, Log)


@needs_mrclam_6
def test_mrclam_6_by_an_independent_count():
    began = time.process_time()
    log = PyfgSource(MRCLAM_6).read()
    assert time.process_time() - began < 2.0
    words = [line.split() for line in MRCLAM_6.read_text().splitlines()]
    tags = Counter(line[0] for line in words)
    assert Counter(type(record) for record in log.records) == {
        Odometry: tags["EDGE_SE2"],
        BearingRangeFix: tags["EDGE_SE2_XY"],
        RangeFix: tags["EDGE_RANGE"],
    }
    assert not log.dropped
    assert log.header.robots == tuple("ABCDE")
    assert log.header.landmarks == tuple(f"L{n}" for n in range(6, 21))
    stamp_of = {line[2]: float(line[1]) for line in words if line[0] == "VERTEX_SE2"}
    legs = {(line[2][0], stamp_of[line[2]]): line for line in words if line[0] == "EDGE_SE2"}
    for step in of_kind(log, Odometry):
        line = legs[step.robot, step.start_s]
        assert step.stamp_s == stamp_of[line[3]]
        assert step.T_start_now.equals(Pose2(*map(float, line[4:7])), 1e-12)
        np.testing.assert_array_equal(np.diag(step.cov_now), np.array(line[7:], float)[[0, 3, 5]])
    points = [line for line in words if line[0] == "EDGE_SE2_XY"]
    polar = Counter((stamp_of[line[2]], line[3], round(np.hypot(float(line[4]), float(line[5])), 6)) for line in points)
    assert Counter((r.stamp_s, r.target, round(r.range_m, 6)) for r in of_kind(log, BearingRangeFix)) == polar
    ranges = Counter((stamp_of[line[2]], float(line[4])) for line in words if line[0] == "EDGE_RANGE")
    assert Counter((r.stamp_s, r.range_m) for r in of_kind(log, RangeFix)) == ranges


@needs_mrclam_6
def test_mrclam_6_says_variances_of_ranges():
    """The ranges against the distances of the true poses: their spread is that of the sigma, not of its square."""
    source = PyfgSource(MRCLAM_6)
    log, truth = source.read(), source.truth()
    places = {
        robot: {stamp: pose.translation() for stamp, pose in zip(track.stamps_s.tolist(), track.poses, strict=True)}
        for robot, track in truth.robots.items()
    }
    fixes = of_kind(log, RangeFix)
    errors = [
        fix.range_m - np.linalg.norm(places[fix.observer][fix.stamp_s] - places[fix.target][fix.stamp_s])
        for fix in fixes
    ]
    sigma = fixes[0].sigma_m
    assert {fix.sigma_m for fix in fixes} == {sigma}
    spread = np.median(np.abs(np.array(errors) - np.median(errors))) * 1.4826  # robust: of a normal distribution
    assert 0.5 * sigma < spread < 2 * sigma
    assert sum(len(track.poses) for track in truth.robots.values()) == 11_274
