"""Data sets to share: a folder that is ready for a data hub."""
