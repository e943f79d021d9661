"""Stars before any model: their noise, moments, splits, and those bright enough to learn from."""
