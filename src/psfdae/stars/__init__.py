"""Stars independent of any model: noise, moments, splits, and bright stars for a training."""
