"""The options of a run: schema, command line, sweeps, help."""
