"""Tasks on many processes and machines, run by Dask."""
