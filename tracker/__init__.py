"""The vision robot tracker: what a camera sees of a target on another robot, and where the target is by a picture.

Two targets, a helix and a cube of AprilTags: rendering, detection with covariances, calibration, Cramer-Rao bound.
Data sheets describe camera and target. The tracker's statistical model is `sim.noise.TrackerNoise`.
"""
