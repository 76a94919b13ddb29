"""The detector that fits a data sheet."""

from tracker.data_sheet import DataSheet
from tracker.detector import Detector
from tracker.helix_detector import HelixDetector
from tracker.tag_detector import TagDetector


def make_detector(sheet: DataSheet) -> Detector:
    """A detector of the data sheet's target, helix or tag cube, in the pictures of its camera."""
    if sheet.helix is not None:
        return HelixDetector(sheet.camera, sheet.helix)
    return TagDetector(sheet.camera, sheet.tag_cube)
