"""Stars of a whole image: joint fits, crowded fields, wings, photon noise."""
