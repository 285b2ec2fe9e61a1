"""Work in other processes, on this machine or on many: views that are scored, cells of a study. By Dask."""
