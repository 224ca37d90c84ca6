"""Files of measured BTFs, and data sets of other programs."""
