"""Checks of a machine: ``mbtf-gen doctor`` and ``mbtf-gen selftest``."""
