"""Diagnosis of an installation: whether each part works here, and whether the physics is right."""
