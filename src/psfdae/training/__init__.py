"""From an image to a training set, the fit, its calibration, and models of exposures."""
