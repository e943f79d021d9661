"""Stars of one's own: FITS files in, PSFs out, and models trained on the stars of an image.

| module | content |
|---|---|
| `images`, `catalogue`, `observation` | files of observers, checked, to stamps |
| `stamps`, `photometry`, `shapes` | what is measured on stamps |
| `bundle`, `model`, `prediction` | a trained network, applied to stamps, and what comes out |
| `selection`, `training_images` | bright stars of an image to learn from |
| `example`, `plot` | a simulated exposure; a map of PSFs |
"""
