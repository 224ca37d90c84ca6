"""Typed configurations of the generator and of the commands that make pictures."""
