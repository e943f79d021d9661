"""Lower bounds of the error: the ideal estimator, which no other estimator can beat."""
