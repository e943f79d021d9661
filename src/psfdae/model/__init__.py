"""Models of the PSF: their fit to the stars of an image, their files, what they predict, their test."""
