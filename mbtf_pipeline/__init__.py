"""Recipes: generation, fits, comparison and report in one command."""
