"""Comparison of fits with references: images, errors on data, offsets, timing."""
