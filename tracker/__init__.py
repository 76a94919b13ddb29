"""The vision robot tracker: target, camera, rendering, detection and calibration."""
