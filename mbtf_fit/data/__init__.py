"""Data sets as the fitter reads them: queries, images, streamed shards, and the validation split."""
