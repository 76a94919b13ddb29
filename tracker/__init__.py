"""For the vision robot tracker: nothing else yet; its statistical model is `sim.noise.TrackerNoise`."""
