"""The PSF at any position of an image: interface, grid, wings, files of other programs."""
