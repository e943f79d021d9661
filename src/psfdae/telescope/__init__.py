"""A telescope as settings: aperture, detector, field, aberrations and seeing."""
