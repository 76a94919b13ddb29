"""The helix target: its pattern against hand-worked points, its shape against points known to lie on it."""

from dataclasses import replace
from math import nan, pi

import numpy as np
import pytest
from scipy.optimize import brentq

from coopslam.errors import BadInput
from coopslam.se2 import Pose2
from tracker.helix import Helix
from tracker.target import Drum

# helix from 0.2 to 0.5 m, stripes 0.1 m high, 0.1 m apart
HELIX = Helix(0.1, 0.15, 0.55, pitch_m=0.2, ring_m=0.05, lower_collar_m=0.05, upper_collar_m=0.05)
DARK, LIGHT = HELIX.dark, HELIX.light


@pytest.mark.parametrize(
    ("azimuth", "z", "expected"),
    [
        (0.0, 0.149, LIGHT),  # collar
        (1.0, 0.151, DARK),  # ring, at any azimuth
        (4.0, 0.199, DARK),
        (0.0, 0.201, DARK),  # stripe from 0.2 to 0.3 at azimuth zero
        (0.0, 0.299, DARK),
        (0.0, 0.301, LIGHT),
        (0.0, 0.399, LIGHT),
        (0.0, 0.401, DARK),
        (pi / 2, 0.249, LIGHT),  # a quarter turn to the left: a quarter of the pitch higher
        (pi / 2, 0.251, DARK),
        (-pi / 2, 0.251, LIGHT),  # and to the right lower, from 0.15 to 0.25
        (-pi / 2, 0.249, DARK),
        (pi, 0.301, DARK),
        (-pi, 0.301, DARK),  # the same generator
        (0.0, 0.501, DARK),  # ring
        (0.0, 0.551, LIGHT),  # collar
    ],
)
def test_hand_worked_reflectance(azimuth, z, expected):
    assert HELIX.reflectance(azimuth, z) == expected


def test_a_target_that_turns_left_shows_its_stripes_lower():
    """By pitch / 2 pi for each radian: the docstring's relation, seen by an observer at a bearing of its own."""
    bearing, turn = 0.4, 0.3
    place = 3 * np.cos(bearing), 3 * np.sin(bearing)

    def edge_m(heading):
        azimuth = HELIX.facing_azimuth_rad(Pose2(*place, heading), camera_forward_m=0.0)
        return brentq(lambda z: HELIX.phase(azimuth, z) - 0.75, 0.29, 0.41)  # middle of a light band, away from jumps

    # phi = 0.4 + pi - 2.9 = 0.6416 at first, so this middle is at 0.2 + 0.2 (0.6416 / 2 pi + 0.75)
    assert edge_m(2.9) == pytest.approx(0.2 + 0.2 * (0.6415927 / (2 * pi) + 0.75), abs=1e-8)
    assert edge_m(2.9 + turn) - edge_m(2.9) == pytest.approx(-0.2 * turn / (2 * pi), abs=1e-9)


def test_facing_azimuth_counts_from_the_targets_own_axis():
    helix = replace(HELIX, forward_m=0.5)
    facing = helix.facing_azimuth_rad(Pose2(3.0, 0.0, pi / 2), camera_forward_m=1.0)
    # The axis is at (3, 0.5), the camera 2 m back and 0.5 m to the right of it.
    assert facing == pytest.approx(np.arctan2(-0.5, -2.0) - pi / 2 + 2 * pi)


@pytest.mark.parametrize("helix", [HELIX, replace(HELIX, stripes=3, duty=0.3, start_rad=1.1), Helix()])
def test_edges_are_where_the_reflectance_jumps(helix):
    heights = np.linspace(helix.helix_bottom_m, helix.helix_top_m, 20_001)[1:-1]
    for azimuth in np.linspace(-pi, pi, 25) + 0.013:
        dark = helix.is_dark(azimuth, heights)
        jumps = np.flatnonzero(dark[1:] != dark[:-1])
        edges = helix.edges(azimuth)
        assert len(edges) == len(jumps)
        np.testing.assert_allclose([z for z, _ in edges], heights[jumps], atol=2e-5)  # the step of the heights
        assert [above for _, above in edges] == dark[jumps + 1].tolist()


def test_the_default_shows_two_edges_of_the_stripe_from_everywhere():
    assert {len(Helix().edges(azimuth)) for azimuth in np.linspace(-pi, pi, 721)} <= {2, 3}


def test_several_stripes_repeat_within_a_turn():
    helix = replace(HELIX, stripes=4)
    azimuth, z = np.random.default_rng(1).uniform([[0.0], [0.16]], [[6.0], [0.54]], (2, 300))
    assert (helix.is_dark(azimuth, z) == helix.is_dark(azimuth + pi / 2, z)).all()
    assert (helix.is_dark(azimuth, z) != helix.is_dark(azimuth + pi / 4, z)).any()


def test_share_of_dark_is_the_duty():
    helix = replace(HELIX, pitch_m=0.1, duty=0.3)  # three whole periods
    azimuth, z = np.random.default_rng(2).uniform([[-pi], [0.2]], [[pi], [0.5]], (2, 40_000))
    assert helix.is_dark(azimuth, z).mean() == pytest.approx(0.3, abs=4 * np.sqrt(0.21 / 40_000))


def test_rays_aimed_at_the_surface_meet_it():
    """Points on the half of the mantle that faces the eye, and on the upper end, are met at distance one."""
    rng = np.random.default_rng(3)
    helix, eye = replace(HELIX, forward_m=0.02), np.array([1.0, -0.5, 0.9])
    away = np.arctan2(-0.5, 1.0 - 0.02)
    half = np.arccos(0.1 / np.hypot(0.98, 0.5))  # up to the silhouette
    azimuth, z = away + rng.uniform(-half, half, 500) * 0.999, rng.uniform(0.1, 0.6, 500)
    mantle = np.stack([0.02 + 0.1 * np.cos(azimuth), 0.1 * np.sin(azimuth), z])
    radius = 0.0999 * np.sqrt(rng.uniform(0, 1, 500))
    end = np.stack([0.02 + radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(500, 0.6)])
    for points in (mantle, end):
        np.testing.assert_allclose(helix.distances(eye, points - eye[:, None]), 1.0, atol=1e-9)
    look = helix.look(mantle)
    np.testing.assert_allclose(look.normals, [np.cos(azimuth), np.sin(azimuth), 0 * z], atol=1e-12)
    np.testing.assert_array_equal(look.reflectance, helix.reflectance(azimuth, z))
    np.testing.assert_array_equal(helix.look(end).normals[2], 1.0)


def test_rays_beside_the_silhouette_or_away_miss():
    drum, eye = Drum(0.1, 0.2, 0.5, 0.5), np.array([2.0, 0.0, 0.3])
    tangent = np.arcsin(0.1 / 2.0)
    angles = np.array([tangent - 1e-6, tangent + 1e-6, -tangent + 1e-6, -tangent - 1e-6, pi])
    directions = np.stack([-np.cos(angles), np.sin(angles), np.zeros(5)])
    assert np.isfinite(drum.distances(eye, directions)).tolist() == [True, False, True, False, False]
    above = np.array([[-1.9], [0.0], [0.2001]])  # over the upper rim
    assert drum.distances(eye, above)[0] == np.inf


def test_extent_holds_the_cylinder():
    hull = HELIX.extent()
    assert (hull[:, 2].min(), hull[:, 2].max()) == pytest.approx((0.1, 0.6))
    for direction in np.random.default_rng(4).standard_normal((50, 2)):
        reach = 0.1 * np.hypot(*direction)  # support function of the circle
        assert reach <= (hull[:, :2] @ direction).max() <= 1.01 * reach


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("radius_m", 0.0),
        ("pitch_m", -0.2),
        ("bottom_m", -0.1),
        ("top_m", 0.15),
        ("stripes", 0),
        ("stripes", 1.0),
        ("duty", 1.0),
        ("ring_m", 0.2),
        ("lower_collar_m", 0.2),
        ("upper_collar_m", nan),
        ("dark", -0.1),
        ("light", 0.05),
        ("start_rad", nan),
        ("forward_m", nan),
    ],
)
def test_an_impossible_helix_is_refused(field, value):
    with pytest.raises(BadInput, match=f"^{field}: "):
        replace(HELIX, **{field: value})


@pytest.mark.parametrize(("field", "value"), [("radius_m", -1.0), ("top_m", 0.2), ("reflectance", 1.5)])
def test_an_impossible_drum_is_refused(field, value):
    with pytest.raises(BadInput, match=f"^{field}: "):
        replace(Drum(0.1, 0.2, 0.5, 0.5), **{field: value})
