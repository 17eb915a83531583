"""Many recordings at once, on the cores of one machine or of many. Dask distributes them."""
