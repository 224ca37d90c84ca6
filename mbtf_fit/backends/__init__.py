"""Back ends: each implements the operations of models in its own language."""
