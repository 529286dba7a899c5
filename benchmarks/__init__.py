"""Benchmarks: ratios against ceilings and peers, each taken in one run. `python -m benchmarks`; docs/performance.md."""
