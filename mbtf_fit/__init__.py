"""Fit neural materials to multi-resolution BTF data."""
