"""Studies: a grid of runs in one file, run anywhere, resumable run by run."""
