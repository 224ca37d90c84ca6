"""Training data in memory and on disk, and what is held out of training."""
