"""PyTorch executes operations: the reference that all other back ends are tested against, differentiable."""
