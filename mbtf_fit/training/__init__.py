"""Training of one fit or of several: schedule, checkpoints, calibration, convergence."""
