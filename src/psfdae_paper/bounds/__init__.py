"""Best possible estimates: what no estimator can beat, and what the ideal one reaches."""
