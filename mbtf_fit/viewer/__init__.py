"""Interactive viewer of materials: one page for browsers, which evaluates the networks in shaders."""
