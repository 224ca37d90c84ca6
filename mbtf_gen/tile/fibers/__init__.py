"""Fibers and yarns: curves, cloth, and the files that describe them."""
