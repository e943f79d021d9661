"""Estimators of the point spread function from a noisy star image."""
