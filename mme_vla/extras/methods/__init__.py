"""Prior methods that the benchmark was measured with, each in a folder."""
