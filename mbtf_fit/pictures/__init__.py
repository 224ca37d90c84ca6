"""Pictures of fitted materials: contact sheets, and comparisons with the path-traced tile."""
