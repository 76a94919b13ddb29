"""Logs of MR.CLAM as they should be, the small one and data set 6: against their own truth and independent counts."""

import shutil
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from mrclam_files import SMALL, append, count, fixes_of, steps_of

from coopslam.errors import BadInput
from coopslam.io.mrclam import MrclamSettings, MrclamSource
from coopslam.records import BearingRangeFix
from coopslam.se2 import Pose2

DATASET_6 = Path(__file__).parents[2] / "shared" / "data" / "mrclam" / "MRCLAM_Dataset6"
needs_dataset_6 = pytest.mark.skipif(not DATASET_6.is_dir(), reason="MR.CLAM data set 6 is not here")


@pytest.fixture
def small(tmp_path):
    return Path(shutil.copytree(SMALL, tmp_path / "log"))


def test_the_small_log_is_what_its_truth_says():
    """Its files were computed without noise and rounded to 0.1 mm, 0.1 mrad and, in the truth, 1 um."""
    source = MrclamSource(SMALL, MrclamSettings(range_is_depth=True))
    log, truth = source.read(), source.truth()
    assert log.name == "two_robots_mrclam"
    assert log.header.robots == ("robot1", "robot2")
    assert log.header.landmarks == ("landmark6", "landmark7", "landmark8")
    assert not log.dropped
    stands = {
        robot: dict(zip(track.stamps_s.tolist(), track.poses, strict=True)) for robot, track in truth.robots.items()
    }
    for fix in fixes_of(log):
        here = stands[fix.observer][fix.stamp_s]
        there = truth.landmarks.get(fix.target)
        if there is None:
            there = stands[fix.target][fix.stamp_s].translation()
        x, y = here.transformTo(there)
        assert fix.bearing_rad == pytest.approx(np.arctan2(y, x), abs=1e-4)
        assert fix.range_m == pytest.approx(np.hypot(x, y), rel=2e-4, abs=2e-4)
    for robot, track in truth.robots.items():
        pose = track.poses[0]
        for step in steps_of(log, robot):
            pose = pose * step.T_start_now
            if step.stamp_s in stands[robot]:
                assert pose.equals(stands[robot][step.stamp_s], 1e-5)
        assert step.stamp_s == track.stamps_s[-1]


def test_sightings_have_the_noise_of_the_settings():
    calm = MrclamSettings(range_sigma_m=0.1, range_sigma_per_m=0.02, range_sigma_per_m2=0.003, bearing_sigma_rad=0.05)
    log = MrclamSource(SMALL, calm).read()
    for fix in fixes_of(log):
        sigma = 0.1 + 0.02 * fix.range_m + 0.003 * fix.range_m**2
        np.testing.assert_allclose(fix.cov, np.diag([0.05**2, sigma**2]), rtol=1e-12)
    assert log.header.sensor_models == {"mrclam": asdict(calm)}


def test_a_range_along_the_line_of_sight_stays_as_it_is():
    raw = np.loadtxt(SMALL / "Robot1_Measurement.dat")
    fixes = fixes_of(MrclamSource(SMALL, MrclamSettings(range_is_depth=False)).read(), "robot1")
    np.testing.assert_array_equal([fix.range_m for fix in fixes], raw[:, 2])


def test_records_are_in_the_order_of_their_stamps_and_odometry_leads():
    records = MrclamSource(SMALL).read().records
    order = [(record.stamp_s, isinstance(record, BearingRangeFix)) for record in records]
    assert order == sorted(order)


@pytest.mark.parametrize(
    ("settings_of", "message"),
    [
        ({"odometry_period_s": 0}, "odometry_period_s"),
        ({"longest_gap_s": float("nan")}, "longest_gap_s"),
        ({"range_sigma_m": 0}, "range_sigma_m"),
        ({"bearing_sigma_rad": -1}, "bearing_sigma_rad"),
        ({"range_sigma_per_m2": -1}, "range_sigma_per_m2"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings_of, message):
    with pytest.raises(BadInput, match=f"^{message}: "):
        MrclamSettings(**settings_of)


@pytest.mark.parametrize("end", ["\r\n", "\n\n", " \t# comment\n", "\r"])
def test_line_ends_blanks_and_comments_make_no_difference(small, end):
    for path in small.iterdir():
        path.write_bytes(path.read_bytes().replace(b"\n", end.encode()))
    log, expected = MrclamSource(small).read(), MrclamSource(SMALL).read()
    assert count(log) == count(expected)
    assert not log.dropped
    assert MrclamSource(small).truth().landmarks.keys() == {"landmark6", "landmark7", "landmark8"}


def test_without_truth_there_is_none(small):
    (small / "Robot2_Groundtruth.dat").unlink()
    assert MrclamSource(small).truth().robots.keys() == {"robot1"}
    (small / "Robot1_Groundtruth.dat").unlink()
    assert MrclamSource(small).truth().robots == {}
    (small / "Landmark_Groundtruth.dat").unlink()
    assert MrclamSource(small).truth() is None
    assert count(MrclamSource(small).read()) == count(MrclamSource(SMALL).read())


def test_stamps_of_the_truth_ascend(small):
    path = small / "Robot1_Groundtruth.dat"
    append(path, "1000.5 9 9 0\n1000.2 7 7 0\n")
    track = MrclamSource(small).truth().robots["robot1"]
    assert (np.diff(track.stamps_s) > 0).all()
    assert len(track.stamps_s) == len(track.poses) == 42
    assert track.poses[track.stamps_s.tolist().index(1000.5)].equals(Pose2(9, 9, 0), 0)
    assert track.poses[1].equals(Pose2(0.08, 0, 0), 1e-12)  # the first of two at 1000.2 s


def test_extra_files_are_ignored(small):
    (small / "Robot7_Odometry.dat").write_text("hello")
    (small / "notes.txt").write_bytes(b"\xff")
    assert count(MrclamSource(small).read()) == count(MrclamSource(SMALL).read())


@needs_dataset_6
def test_data_set_6_by_an_independent_count():
    source = MrclamSource(DATASET_6)
    log = source.read()
    owner = {int(code): int(subject) for subject, code in np.loadtxt(DATASET_6 / "Barcodes.dat")}
    nobody, expected = Counter(), Counter()
    for number in range(1, 6):
        for stamp, code, _, _ in np.loadtxt(DATASET_6 / f"Robot{number}_Measurement.dat"):
            subject = owner.get(int(code))
            if subject is None:
                nobody[f"bearing_range: barcode {code:.0f} belongs to nobody"] += 1
            else:
                target = f"robot{subject}" if subject < 6 else f"landmark{subject}"
                expected[stamp, f"robot{number}", target] += 1
    assert Counter((fix.stamp_s, fix.observer, fix.target) for fix in fixes_of(log)) == expected
    assert {why: number for why, number in log.dropped.items() if "barcode" in why} == nobody
    assert log.header.robots == tuple(f"robot{n}" for n in range(1, 6))
    assert log.header.landmarks == tuple(f"landmark{n}" for n in range(6, 21))
    stamps = [record.stamp_s for record in log.records]
    assert stamps == sorted(stamps)


@needs_dataset_6
@pytest.mark.parametrize("number", [1, 4])
def test_data_set_6_drives_where_fine_euler_steps_lead(number):
    """Each command cut into 20, midpoint rule: error of 1e-6 m over the 100 m."""
    rows = np.loadtxt(DATASET_6 / f"Robot{number}_Odometry.dat")
    dt = np.repeat(np.diff(rows[:, 0]) / 20, 20)
    v, w = np.repeat(rows[:-1, 1], 20), np.repeat(rows[:-1, 2], 20)
    heading = np.cumsum(w * dt)
    where = np.sum(v * dt * np.exp(1j * (heading - w * dt / 2)))
    total, pause = Pose2(), 0.0
    steps = steps_of(MrclamSource(DATASET_6).read(), f"robot{number}")
    for step in steps:
        total = total * step.T_start_now
        pause += (step.stamp_s - step.start_s) * (not step.cov_now.any())
    assert total.equals(Pose2(where.real, where.imag, heading[-1]), 1e-5)
    stands = ~rows[:-1, 1:].any(axis=1)
    assert pause == pytest.approx(np.diff(rows[:, 0])[stands].sum(), abs=1e-3)
    assert (steps[0].start_s, steps[-1].stamp_s) == (rows[0, 0], rows[-1, 0])


@needs_dataset_6
def test_data_set_6_has_its_truth_and_takes_little_time():
    source = MrclamSource(DATASET_6)
    began = time.process_time()
    source.read()
    truth = source.truth()
    assert time.process_time() - began < 3.0
    rows = np.loadtxt(DATASET_6 / "Robot5_Groundtruth.dat")
    track = truth.robots["robot5"]
    np.testing.assert_array_equal(track.stamps_s, rows[:, 0])
    np.testing.assert_allclose([pose.translation() for pose in track.poses], rows[:, 1:3], rtol=1e-15)
    turned = np.array([pose.theta() for pose in track.poses]) - rows[:, 3]
    np.testing.assert_allclose(np.exp(1j * turned), 1, atol=1e-12)
    landmarks = np.loadtxt(DATASET_6 / "Landmark_Groundtruth.dat")
    assert truth.robots.keys() == {f"robot{n}" for n in range(1, 6)}
    np.testing.assert_array_equal([truth.landmarks[f"landmark{n}"] for n in range(6, 21)], landmarks[:, 1:3])
