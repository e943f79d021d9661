"""Models of the PSF of an image: their fit, their files, what they predict, their test."""
