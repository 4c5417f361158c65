"""The paper's figures at print size, each with its data beside it: `python -m benchmarks.paper --out out/figures`."""
