"""A library of materials: one run of a recipe for each, failures named and skipped, one page for all."""
