import json
from collections import Counter
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from mutations import damaged

from coopslam.errors import BadInput
from coopslam.io.g2o_log import G2oSource
from coopslam.io.log import Log
from coopslam.records import BearingFix, BearingRangeFix, LoopClosure, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, observer_to_target_axes

SMALL = Path(__file__).parents[1] / "datasets" / "logs" / "two_robots.g2o"
I3 = "1 0 0 1 0 1"


def written(tmp_path, text, keys=None):
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    if keys is not None:
        (tmp_path / "graph.keys.json").write_text(keys if isinstance(keys, str) else json.dumps(keys))
    return G2oSource(path)


def test_the_small_graph_by_hand():
    source = G2oSource(SMALL)
    log = source.read()
    assert (log.name, log.header.robots, log.header.landmarks) == (
        "two_robots.g2o",
        ("a", "b"),
        ("landmark1", "landmark2"),
    )
    assert not log.dropped
    assert source.truth() is None
    assert Counter(type(record) for record in log.records) == {
        Odometry: 6,
        LoopClosure: 2,
        RelativePoseFix: 1,
        BearingRangeFix: 2,
    }
    fix = next(record for record in log.records if isinstance(record, BearingRangeFix))
    assert (fix.stamp_s, fix.observer, fix.target) == (0, "a", "landmark1")
    np.testing.assert_allclose(fix.cov, np.diag([0.0025 / 2, 0.0025]), atol=1e-12)  # 0.05 m across sqrt(2) m


def test_the_records_weigh_what_gtsam_reads():
    """gtsam's own reading of the file, and Between factors of our records, at poses 1e-4 from where they would be."""
    factors, values = gtsam.readG2o(str(SMALL), False)
    rng = np.random.default_rng(2)
    keys = [key for key in values.keys() if gtsam.symbolChr(key) in b"ab"]  # noqa: SIM118 (Values are no dict)
    ours, moved = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key in keys:
        moved.insert(key, values.atPose2(key) * Pose2(*rng.normal(size=3) * 1e-4))
    for record in G2oSource(SMALL).read().records:
        match record:
            case Odometry():
                ends = (record.robot, record.start_s), (record.robot, record.stamp_s)
                T, cov = record.T_start_now, record.cov_now
            case LoopClosure():
                ends = (record.earlier_robot, record.earlier_s), (record.robot, record.stamp_s)
                T, cov = record.T_earlier_now, record.cov_now
            case RelativePoseFix():
                ends = (record.observer, record.stamp_s), (record.target, record.stamp_s)
                T = record.T_observer_target
                cov = observer_to_target_axes(T, record.cov_observer)
            case _:
                continue
        symbols = [gtsam.symbol(robot, int(stamp)) for robot, stamp in ends]
        ours.add(gtsam.BetweenFactorPose2(*symbols, T, gtsam.noiseModel.Gaussian.Covariance(cov)))
    theirs = [factors.at(k) for k in range(factors.size())]
    assert len(theirs) == ours.size() == 9
    written_as = sorted(factor.error(moved) for factor in theirs)
    np.testing.assert_allclose(sorted(ours.at(k).error(moved) for k in range(9)), written_as, rtol=1e-3)


def test_plain_numbers_are_one_robot(tmp_path):
    text = "".join(f"VERTEX_SE2 {k} 0 0 0\n" for k in range(4)) + "VERTEX_XY 9 1 1\n"
    text += "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0 {I3}\n" for k in range(3))
    text += f"EDGE_SE2 3 0 0 0 0 {I3}\nEDGE_SE2_XY 2 9 1 1 1 0 1\nEDGE_BEARING_SE2_XY 1 9 0.5 400\nFIX 2\n"
    log = written(tmp_path, text).read()
    assert (log.header.robots, log.header.landmarks) == (("robot",), ("landmark9",))
    assert [step.stamp_s for step in log.records if isinstance(step, Odometry)] == [1, 2, 3]
    (bearing,) = [record for record in log.records if isinstance(record, BearingFix)]
    assert (bearing.stamp_s, bearing.target, bearing.bearing_rad, bearing.sigma_rad) == (1, "landmark9", 0.5, 0.05)
    assert log.dropped == {"FIX: a vertex other than the first pose of the first robot, which is the origin": 1}


def test_the_symbols_of_gtsam_name_landmarks_too(tmp_path):
    pose, point = gtsam.symbol("x", 7), gtsam.symbol("p", 3)
    text = f"VERTEX_SE2 {pose} 0 0 0\nVERTEX_XY {point} 1 1\nEDGE_SE2_XY {pose} {point} 1 1 1 0 1\n"
    log = written(tmp_path, text).read()
    assert (log.header.robots, log.header.landmarks, log.records[0].stamp_s) == (("x",), ("p3",), 7)


KEYS = {
    "0": {"kind": "pose", "robot": "scout", "index": 0, "stamp_s": 0.5},
    "1": {"kind": "pose", "robot": "scout", "index": 1, "stamp_s": 2.5},
    "2": {"kind": "pose", "robot": "rover", "index": 0, "stamp_s": 2.5},
    "3": {"landmark": "door"},
}
GRAPH = (
    "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 2 2 0 0\nVERTEX_XY 3 1 1\n"
    f"EDGE_SE2 0 1 1 0 0 {I3}\nEDGE_SE2 1 2 1 0 0 {I3}\nEDGE_SE2_XY 0 3 1 1 1 0 1\nEDGE_BEARING_SE2 1 2 0.1 4\n"
)


def test_the_keys_beside_a_graph_say_who_and_when(tmp_path):
    log = written(tmp_path, GRAPH, KEYS).read()
    assert (log.header.robots, log.header.landmarks) == (("rover", "scout"), ("door",))
    said = [(type(record), record.stamp_s) for record in log.records]
    assert said == [(BearingRangeFix, 0.5), (Odometry, 2.5), (RelativePoseFix, 2.5), (BearingFix, 2.5)]


def test_who_stands_is_seen_later_and_drives_on_then(tmp_path):
    """The rover stands from 0 to 4 s and is seen by the scout, which arrives at 2.5 s."""
    keys = KEYS | {"2": {"robot": "rover", "index": 0, "stamp_s": 0, "until_s": 4}}
    keys["1"] = keys["1"] | {"until_s": 3.0}
    log = written(tmp_path, GRAPH, keys).read()
    assert not log.dropped
    said = [(type(record), record.stamp_s) for record in log.records]
    assert said == [(BearingRangeFix, 0.5), (Odometry, 2.5), (RelativePoseFix, 2.5), (BearingFix, 2.5)]
    drives_on = GRAPH + f"VERTEX_SE2 4 3 0 0\nEDGE_SE2 1 4 1 0 0 {I3}\n"
    keys["4"] = {"robot": "scout", "index": 2, "stamp_s": 5.0}
    odometry = [record for record in written(tmp_path, drives_on, keys).read().records if isinstance(record, Odometry)]
    assert [(leg.start_s, leg.stamp_s) for leg in odometry] == [(0.5, 2.5), (3.0, 5.0)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"2": {"kind": "vertex", "vertex": 7}}, "id 2 is {'kind': 'vertex', 'vertex': 7}, not a robot's pose: map"),
        ({"2": {"robot": 7, "index": 0}}, "id 2: the robot 7; expected a name"),
        ({"2": {"robot": "a\nb", "index": 0}}, r"id 2: the robot 'a.*b'; expected a name"),
        ({"2": {"robot": "b", "index": -1}}, "id 2: the index -1; expected a whole number"),
        ({"2": {"robot": "b", "index": True}}, "id 2: the index True; expected a whole number"),
        ({"2": {"robot": "b", "index": 0, "stamp_s": "now"}}, "id 2: stamp_s 'now'; expected seconds"),
        ({"2": {"robot": "b", "index": 0, "stamp_s": 2, "until_s": 1}}, "id 2: until_s 1 lies before stamp_s 2"),
        ({"2": {"robot": "b", "index": 0, "until_s": None}}, "id 2: until_s None; expected seconds"),
        ({"3": {"landmark": 7}}, "id 3: the landmark 7; expected a name"),
        ({"2": 7}, "expected an object such as"),
        ({"two": {}}, "expected the ids of vertices as keys"),
    ],
)
def test_keys_that_say_nothing_usable(tmp_path, change, message):
    with pytest.raises(BadInput, match=rf"graph\.keys\.json: .*{message}"):
        written(tmp_path, GRAPH, KEYS | change).read()


def test_keys_that_miss_a_vertex_or_are_no_json(tmp_path):
    with pytest.raises(BadInput, match="graph.keys.json: id 2 is missing"):
        written(tmp_path, GRAPH, {key: what for key, what in KEYS.items() if key != "2"}).read()
    with pytest.raises(BadInput, match="graph.keys.json: line 1"):
        written(tmp_path, GRAPH, "{,}").read()
    with pytest.raises(BadInput, match="graph.g2o: vertex 2: 2 is there already"):
        written(tmp_path, GRAPH, KEYS | {"2": KEYS["1"]}).read()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE_SE2 0 2 0 0 0 0 0 0 0 0 0", r"edge 0 -> 2: the information matrix \[0.0, .*\] has no inverse"),
        ("EDGE_SE2 0 2 0 0 0 1 0 0 1 0 -1", "edge 0 -> 2: the information matrix .* has no inverse"),
        ("EDGE_SE2 0 2 0 0 0 1 1 0 1 0 1", "edge 0 -> 2: the information matrix .* has no inverse"),
        ("EDGE_SE2_XY 0 3 1 1 1 2 1", "edge 0 -> 3: the information matrix .* has no inverse"),
        ("EDGE_BEARING_SE2 0 2 1 0", "edge 0 -> 2: the information 0; expected more than zero"),
        (f"EDGE_SE2 0 7 0 0 0 {I3}", "edge 0 -> 7: there is no vertex 7 that is a pose"),
        (f"EDGE_SE2 0 3 0 0 0 {I3}", "edge 0 -> 3: there is no vertex 3 that is a pose"),
        ("VERTEX_SE2 -1 0 0 0", "vertex -1: expected an id of zero or more, below 2.64"),
        ("VERTEX_XY 18446744073709551616 0 0", "vertex 18446744073709551616: expected an id"),
        ("VERTEX_SE2 0 0 0 0", "vertex 0: 0 is there already"),
        ("EDGE_SE3:QUAT 0 1 0 0 0", "line 9: unknown tag"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, line, message):
    with pytest.raises(BadInput, match=rf"graph\.g2o: {message}") as caught:
        written(tmp_path, GRAPH + line + "\n").read()
    assert "\n" not in str(caught.value)


def test_a_graph_without_edges_is_no_log(tmp_path):
    with pytest.raises(BadInput, match="graph.g2o: no edges in it"):
        written(tmp_path, "VERTEX_SE2 0 0 0 0\nFIX 0\n").read()
    with pytest.raises(BadInput, match="graph.g2o: no poses in it"):
        written(tmp_path, "").read()


@settings(max_examples=200)
@given(damaged(SMALL.read_bytes()))
def test_damage_is_read_over_or_named_in_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "damaged.g2o"
    path.write_bytes(content)
    try:
        log = G2oSource(path).read()
    except BadInput as error:
        assert str(error).isprintable()
    else:
        assert isinstance(log, Log)
