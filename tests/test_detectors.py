"""What all detectors of the robot tracker have in common: whom a data sheet names, noise, what they refuse."""

import numpy as np
import pytest
from scipy.stats import chi2
from tracker_scenes import SHEETS

from coopslam.errors import BadInput
from coopslam.se2 import Pose2, xytheta
from tracker.background import Background
from tracker.data_sheet import load_data_sheet
from tracker.detectors import make_detector
from tracker.helix_detector import Belief, HelixDetector
from tracker.render import RenderSettings, render
from tracker.tag_detector import TagDetector, TagDetectorSettings

HELIX, TAG_CUBE = (load_data_sheet(SHEETS / f"{name}_640x480.toml") for name in ("helix", "tag_cube"))
both = pytest.mark.parametrize("sheet", [HELIX, TAG_CUBE], ids=["helix", "tag_cube"])


def test_a_data_sheet_has_its_detector():
    assert isinstance(make_detector(HELIX), HelixDetector)
    assert isinstance(make_detector(TAG_CUBE), TagDetector)


@both
@pytest.mark.parametrize(
    "image", [np.zeros((480, 640)), np.zeros((10, 10), np.uint8), np.zeros((480, 640, 3), np.uint8), None]
)
def test_a_picture_of_another_kind_is_said_in_one_line(sheet, image):
    with pytest.raises(
        BadInput, match=r"^image: a picture of uint8 \(480, 640\) \(rows, columns\) expected, got [^\n]*$"
    ):
        make_detector(sheet).detect(image)


@both
def test_the_noise_of_a_scene_scatters_no_more_than_its_covariance_says(sheet):
    """40 pictures of one scene that differ in noise. Less is right: what is the same in all of them is said, too."""
    pose, settings = Pose2(4.0, 0.6, 2.7), RenderSettings(background=Background("plain"))
    detector, rngs = make_detector(sheet), map(np.random.default_rng, range(40))
    found = [detector.detect(render(sheet.camera, sheet.target, pose, settings, rng)) for rng in rngs]
    scatter = np.var([xytheta(each.T_observer_target) for each in found], axis=0, ddof=1)
    said = np.mean([np.diag(each.cov_observer) for each in found], axis=0)
    assert (scatter / said < chi2.ppf(0.9995, 39) / 39).all()


@pytest.mark.parametrize("settings", [Belief, TagDetectorSettings])
def test_settings_name_the_field(settings):
    with pytest.raises(BadInput, match="explained_min: more than zero"):
        settings(explained_min=0.0)
