"""Polygon worlds, true motion, true noise and sensors: executes what the explorer decides."""
