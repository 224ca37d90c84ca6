"""Data sets on disk: shards, manifest, locks, verification."""
