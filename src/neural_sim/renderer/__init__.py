"""Render images with opacity from cameras: mesh rasteriser, ray caster and radiance fields."""
