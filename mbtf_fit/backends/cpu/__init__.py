"""The compiled kernel: fits and evaluates lists of operations that match its fused pattern."""
