"""Diagnosis of the machine, and the self-test of the physics."""
