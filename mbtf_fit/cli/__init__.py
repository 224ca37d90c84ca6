"""Commands of ``mbtf-fit``, one file each."""
