"""Studies and timings: `python -m benchmarks NAME`, or `--smoke` for a small run of each."""
