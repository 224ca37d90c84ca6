"""What training minimizes: losses, the noise of the data, regularization."""
