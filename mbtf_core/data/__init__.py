"""Data sets on disk: schema, arrays, manifest, sidecars, verification, stores."""
