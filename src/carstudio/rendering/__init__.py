"""Rays, cones, samples, encodings and volume rendering; the field arrives as a function."""
