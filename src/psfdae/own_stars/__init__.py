"""Stars of one's own: FITS files in, PSFs out, and models trained on the stars of an image.

| module | content |
|---|---|
| `images`, `catalogue`, `observation` | files of observers, checked, to stamps |
| `detection` | stars of an image without a list |
| `stamps`, `photometry`, `shapes` | what is measured on stamps |
| `bundle`, `model`, `prediction` | a trained network, applied to stamps, and what comes out |
| `selection`, `training_images` | bright stars of an image to learn from |
| `advice`, `report` | what an image says of settings; whether to trust a model |
| `example`, `plot` | a simulated exposure; a map of PSFs |
"""
