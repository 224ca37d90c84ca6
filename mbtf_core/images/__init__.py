"""Images as arrays: readers of EXR, PNG, JPG, TIFF and npy, their metadata, resampling."""
