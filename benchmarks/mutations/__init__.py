"""Makers of small inputs with mutations whose right reading they know."""
