"""Back ends: each executes the operations of :mod:`mbtf_fit.ops`, and knows no model."""
