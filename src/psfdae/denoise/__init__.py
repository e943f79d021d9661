"""One star: flux and sky of a stamp, its PSF by a method, errors and flags; the model file."""
