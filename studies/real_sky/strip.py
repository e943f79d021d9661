"""Draw stars of the real image as the field model restores them: `strip.py IMAGE LIST OUT.png`.

The figure at the top of README: held-out bright stars, degraded to S/N 10, and restored.
"""

import sys

import psfdae

image, star_list, figure_path = sys.argv[1:]
# Pixel scale and saturation level of the camera, which the image's header does not have.
stars = psfdae.Stars.from_image(
    image, catalogue=star_list, pixel_scale_arcsec=5.21, saturate=4000, stamp_px=10
)
report = psfdae.validate(psfdae.fit(stars, method="field"), stars)
print(report)
report.strip().savefig(figure_path, dpi=110)
