"""Camera to image and opacity: mesh rasteriser, ray caster, radiance field."""
