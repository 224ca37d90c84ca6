"""Tasks and where they run: in this process, in processes of this machine, on workers of Dask."""
