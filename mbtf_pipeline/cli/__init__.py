"""Commands of ``mbtf-pipeline``, one file each."""
