"""36 negative controls, which must be noticed, 7 invariances, which must not, and the runner of both."""
