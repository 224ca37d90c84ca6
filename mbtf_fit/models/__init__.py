"""Models: one file each, found by :mod:`mbtf_fit.models.registry`. No file imports PyTorch before it
trains."""
