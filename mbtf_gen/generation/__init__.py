"""Data sets from materials and measured BTFs: generated, resumed, repaired, imported."""
