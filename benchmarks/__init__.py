"""Speed of the layer beside its peers. Run with `make bench`, or `python -m benchmarks --help`."""
