"""Perspective pictures of a tile: cameras, and stored references."""
