"""Flight reports, benchmarks and campaigns."""
