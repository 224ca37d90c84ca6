"""What a run computes: its job (configuration, material, queries), effects, paths per query, and forecast."""
