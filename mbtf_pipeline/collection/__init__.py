"""Runs of several materials: a library with one page, or a paper with tables."""
