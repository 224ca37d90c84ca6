"""Comparison of fits with references: pictures, errors on data, offsets, timing."""
